"""Alert rules fire on faults of a live service, and its /metrics has values for every dashboard query."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from long_jobs import LONG, long_sequence
from prometheus import Prometheus, binary, quantile
from serving import Running, Serve, form, npz
from serving import until as until_

from benchmarks.installation.instance import children

DEPLOY = Path(__file__).parents[3] / "deploy"
RULES: list[dict[str, Any]] = yaml.safe_load((DEPLOY / "prometheus" / "alerts.yml").read_text())["groups"][0]["rules"]
PANELS = json.loads((DEPLOY / "grafana" / "pliant.json").read_text())["panels"]
EVERY = 15.0
"""Seconds between two scrapes on the simulated clock; the test does not wait for them."""


class Observer:
    """Scrapes a live service on a simulated clock and evaluates the rules each time, as Prometheus does."""

    def __init__(self, http: httpx.Client) -> None:
        self.http, self.prometheus, self.now = http, Prometheus(), 0.0

    def look(self, times: int = 1, *, every: float = EVERY) -> set[str]:
        """Scrape and return the alerts that fire."""
        firing: set[str] = set()
        for _ in range(times):
            self.now += every
            self.prometheus.scrape(self.http.get("/metrics").text, at=self.now)
            firing = self.prometheus.firing(RULES)
        return firing


@contextmanager
def worker(running: Running, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run one worker without a supervisor that would restart it."""
    env = {**os.environ, **running.jobs.settings.to_environment(), "PLIANT_THREADS": "1"}
    with log.open("ab") as out:
        process = subprocess.Popen([sys.executable, "-m", "pliant.worker", "work"], env=env, stderr=out)
    try:
        until_(lambda: running.jobs.queue.workers(), seconds=60)
        yield process
    finally:
        process.kill()
        process.wait(30)


def long_job(http: httpx.Client) -> str:
    sequence = long_sequence()
    parts = form(
        npz(tracks=sequence.tracks.points), mesh="none", rotations=npz(rotations=sequence.rotations),
        options={**LONG, "outputs": []},
    )  # fmt: skip
    answer = http.post("/v1/jobs", files=parts)
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
def test_killed_processes_fire_their_alerts(serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    running = serve()
    with httpx.Client(base_url=running.url, timeout=20) as http:
        observer = Observer(http)
        with worker(running, tmp_path / "log") as process:
            assert observer.look(8) == set()
            for _ in range(3):
                id = long_job(http)
                until_(lambda id=id: http.get(f"/v1/jobs/{id}").json()["progress"], seconds=60)  # type: ignore[misc]
                (job_process,) = children(process.pid)
                os.kill(job_process, signal.SIGKILL)
                until_(lambda id=id: http.get(f"/v1/jobs/{id}").json()["status"] == "failed", seconds=60)  # type: ignore[misc]
                assert http.get(f"/v1/jobs/{id}").json()["error"]["code"] == "worker_lost"
                firing = observer.look(2)
            assert firing == {"PliantWorkersLost"}
            process.kill()
            process.wait(30)
            for name in running.jobs.queue.workers():  # its heartbeat expires within 20 s
                running.jobs.queue._redis.pexpire(f"{running.jobs.settings.queue}:worker:{name}", 1)  # type: ignore[attr-defined]
            until_(lambda: not running.jobs.queue.workers(), seconds=60)
            assert observer.look(5) == {"PliantWorkersLost"}, "no job waits"
            waiting = long_job(http)
            assert "PliantNoWorker" not in observer.look(20), "it may be starting for five minutes"
            assert observer.look() == {"PliantNoWorker", "PliantWorkersLost"}
            assert http.post(f"/v1/jobs/{waiting}/cancel").is_success
        with worker(running, tmp_path / "log"):
            assert observer.look() == {"PliantWorkersLost"}, "half an hour looks back"
            assert observer.look(31, every=60.0) == set()
            began = time.time()
            id = http.post(
                "/v1/jobs", files=form(mesh="none", options={"method": "pseudo_inverse", "outputs": []})
            ).json()["id"]
            until_(lambda: http.get(f"/v1/jobs/{id}").json()["status"] in ("succeeded", "failed"), seconds=60)
            assert http.get(f"/v1/jobs/{id}").json()["status"] == "succeeded", time.time() - began
            observer.look(4)
            for panel in PANELS:
                for target in panel["targets"]:
                    assert observer.prometheus.query(target["expr"]), (panel["title"], target["expr"])


def test_an_unreachable_store_fires_its_alert(serve: Serve) -> None:
    running = serve(redis_url="redis://127.0.0.1:1")
    with httpx.Client(base_url=running.url, timeout=20) as http:
        observer = Observer(http)
        assert observer.look() == set()
        assert "PliantStoreDown" in observer.look(5)


@pytest.mark.parametrize(
    ("slow", "depth", "load"),
    [("GET", 1, {"PliantSlow", "PliantQueueStuck"}), ("PUT", 0, set())],
    ids=["load", "uploads"],
)
def test_load_dependent_alerts_fire_on_synthetic_metrics(slow: str, depth: int, load: set[str]) -> None:
    prometheus = Prometheus()
    told = (
        'pliant_http_requests_total{{status="200"}} {ok}\npliant_http_requests_total{{status="503"}} {failed}\n'
        'pliant_http_request_duration_seconds_bucket{{method="{slow}",route="/v1/jobs/{{id}}",le="1.0"}} {fast}\n'
        'pliant_http_request_duration_seconds_bucket{{method="{slow}",route="/v1/jobs/{{id}}",le="2.5"}} {ok}\n'
        'pliant_http_request_duration_seconds_bucket{{method="{slow}",route="/v1/jobs/{{id}}",le="+Inf"}} {ok}\n'
        'pliant_webhooks_total{{result="given_up"}} {given_up}\npliant_store_up 1\n'
        "pliant_queue_oldest_seconds {age}\npliant_queue_depth {depth}\n"
    )
    for step in range(50):
        now = {"ok": 100 * step, "failed": 10 * step, "fast": 90 * step, "given_up": step // 40, "age": 60 * step}
        prometheus.scrape(told.format(**now, slow=slow, depth=depth), at=EVERY * step)
        firing = prometheus.firing(RULES)
    assert firing == {"PliantErrors", "PliantWebhooksFail", *load}


def test_a_missing_worker_fires_for_its_installation_alone() -> None:
    """Workers of another installation hid it: all that one Prometheus scrapes counted together."""
    prometheus = Prometheus()
    with_worker, without = (
        'pliant_workers_alive{{namespace="{0}"}} {1}\npliant_jobs{{namespace="{0}",status="queued"}} 1\n'.format(*each)
        for each in (("a", 1), ("b", 0))
    )
    for step in range(21):
        prometheus.scrape(f"{with_worker}{without}pliant_store_up 1\n", at=EVERY * step)
        assert prometheus.firing(RULES) == ({"PliantNoWorker"} if step == 20 else set())
    (rule,) = (each for each in RULES if each["alert"] == "PliantNoWorker")
    assert prometheus.query(rule["expr"]) == {frozenset({("namespace", "b")}): 0.0}


def test_workers_that_are_scaled_to_zero_on_purpose_fire_no_alert() -> None:
    """KEDA starts the first one once a job waits, which takes minutes where a machine has to start."""
    prometheus = Prometheus()
    for step in range(240):
        waits, alive = 40 <= step < 58, 58 <= step < 100
        told = f'pliant_workers_alive {int(alive)}\npliant_jobs{{status="queued"}} {int(waits)}\npliant_store_up 1\n'
        prometheus.scrape(told, at=EVERY * step)
        assert prometheus.firing(RULES) == set(), step


def test_a_readiness_probe_while_there_is_no_worker_is_no_error() -> None:
    prometheus = Prometheus()
    for step in range(50):
        told = f'pliant_store_up 1\npliant_http_requests_total{{route="/readyz",status="503"}} {10 * step}\n'
        prometheus.scrape(told, at=EVERY * step)
        assert prometheus.firing(RULES) == set()


def test_missing_metrics_fire_their_alert() -> None:
    prometheus = Prometheus()
    firing = []
    for step in range(20):
        prometheus.scrape("pliant_store_up 1\n" if step < 10 else "", at=EVERY * step)
        firing.append(prometheus.firing(RULES))
    assert firing == [set()] * 18 + [{"PliantNotScraped"}] * 2


def test_the_rule_evaluator_follows_prometheus_semantics() -> None:
    prometheus = Prometheus()
    for at, counts in ((0, (5, 1)), (60, (7, 2)), (120, (1, 4))):  # the first counter is reset at 120 s
        text = "\n".join(f'c_total{{k="{k}"}} {n}' for k, n in zip("ab", counts, strict=True))
        prometheus.scrape(f"# TYPE c counter\n{text}\n", at=float(at))
    a, b = frozenset({("k", "a")}), frozenset({("k", "b")})
    assert prometheus.query("increase(c_total[2m])") == {a: 2.0, b: 3.0}
    assert prometheus.query('rate(c_total{k!~"a|x"}[1m])') == {b: 2 / 60}
    assert prometheus.query("sum(c_total) / sum(c_total) * 2") == {frozenset(): 2.0}
    assert prometheus.query("max by (k) (c_total) >= 4") == {b: 4.0}
    assert prometheus.query("c_total and on() sum(c_total) > 4") == {a: 1.0, b: 4.0}
    assert prometheus.query('c_total and on(k) c_total{k="b"} > 1') == {b: 4.0}
    assert prometheus.query("c_total and on() sum(c_total) > 5") == prometheus.query("absent(c_total)") == {}
    assert prometheus.query("absent(d_total)") == {frozenset(): 1.0}
    assert binary("==", {a: 1.0, b: 2.0}, {a: 1.0}) == {a: 1.0}
    buckets = {frozenset({("le", le)}): n for le, n in (("1", 5.0), ("2", 10.0), ("+Inf", 10.0))}
    assert quantile(0.75, buckets) == {frozenset(): 1.5}
    assert quantile(0.5, {frozenset({("le", "+Inf")}): 0.0}) == {}

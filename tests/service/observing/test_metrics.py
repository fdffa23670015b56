"""The values at /metrics, read by Prometheus' own parser."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import httpx
from pliant.schemas.job import Problem, Status
from pliant.service.metrics import Metrics
from pliant.worker.jobs import lifecycle
from pliant.worker.tokens import Scope
from prometheus_client.parser import text_string_to_metric_families
from serving import NOW, Running, Serve, claim, finish, submit

Numbers = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def read(text: str) -> Numbers:
    found = {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert len(found) == sum(not line.startswith("#") for line in text.splitlines()), "no line appears twice"
    return found


def at(numbers: Numbers, name: str, **labels: str) -> float:
    return numbers.get((name, tuple(sorted(labels.items()))), 0.0)


def test_metrics_count_jobs_and_requests(serve: Serve) -> None:
    running: Running = serve()
    with httpx.Client(base_url=running.url) as http:
        before = read(http.get("/metrics").text)
        assert at(before, "pliant_jobs", status="queued") == 0
        done, failed, waiting = (submit(http, name=name) for name in ("done", "failed", "waiting"))
        finish(running, done.id, b"x" * 1000)
        token = claim(running, failed.id)
        problem = Problem(title="T", status=500, detail="It broke. Try again.", code="out_of_memory")
        later = NOW + timedelta(seconds=7)
        running.jobs.records.update(
            failed.id, lambda held: lifecycle.fail(held, attempt_id=token, problem=problem, now=later, retention=0)
        )
        http.get(f"/v1/jobs/{waiting.id}")
        http.get(f"/v1/jobs/{waiting.id}", headers={"Prefer": "wait=1"})
        http.get("/v1/jobs/nobody")
        http.get("/nowhere/at/all")
        answer = http.get("/metrics")
    assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    now = read(answer.text)
    assert {status: at(now, "pliant_jobs", status=status) for status in ("queued", "running", "succeeded", "failed")} == {
        "queued": 1, "running": 0, "succeeded": 1, "failed": 1,
    }  # fmt: skip
    assert (
        at(now, "pliant_jobs_ended_total", status="succeeded")
        == at(now, "pliant_jobs_ended_total", status="failed")
        == 1
    )
    assert at(now, "pliant_jobs_failed_total", code="out_of_memory") == 1
    ran = {
        bound: at(now, "pliant_job_run_seconds_bucket", status="failed", le=bound)
        for bound in ("5", "10", "3600", "+Inf")
    }
    assert ran == {"5": 0, "10": 1, "3600": 1, "+Inf": 1}
    assert at(now, "pliant_job_run_seconds_sum", status="failed") == 7
    assert at(now, "pliant_job_run_seconds_count", status="succeeded") == 1
    assert 0 <= at(now, "pliant_queue_oldest_seconds") < 60
    assert at(now, "pliant_queue_depth") == 3, "nobody has taken what the test claimed"
    assert at(now, "pliant_workers_alive") == 0
    assert at(now, "pliant_stored_bytes") == running.jobs.records.used() > 1000
    assert at(now, "pliant_store_up") == 1
    assert at(now, "pliant_http_requests_total", method="POST", route="/v1/jobs", status="202") == 3
    assert at(now, "pliant_http_requests_total", method="GET", route="/v1/jobs/{id}", status="404") == 1
    assert at(now, "pliant_http_requests_total", method="GET", route="other", status="404") == 1
    assert at(now, "pliant_http_request_duration_seconds_count", method="GET", route="/v1/jobs/{id}") == 2, (
        "without the wait"
    )
    assert at(now, "pliant_http_requests_in_progress") == 1, "this request itself"
    assert "nobody" not in answer.text, "addresses are strangers' text"


def test_metrics_require_the_admin_scope(serve: Serve) -> None:
    running = serve(auth="required")
    assert httpx.get(f"{running.url}/metrics").status_code == 401
    with running.client() as user, running.client(Scope.ADMIN) as admin:
        assert user.get("/metrics").json()["code"] == "insufficient_scope"
        numbers = read(admin.get("/metrics").text)
    assert at(numbers, "pliant_http_requests_total", method="GET", route="other", status="401") == 1
    assert at(numbers, "pliant_http_requests_total", method="GET", route="other", status="403") == 1


def test_metrics_report_an_unreachable_store(serve: Serve, tmp_path: Path) -> None:
    running = serve(redis_url=f"unix://{tmp_path}/nobody.sock")
    answer = httpx.get(f"{running.url}/metrics", timeout=30)
    assert answer.status_code == 200
    numbers = read(answer.text)
    assert at(numbers, "pliant_store_up") == 0
    assert ("pliant_queue_depth", ()) not in numbers


def test_unknown_methods_count_as_other_and_labels_are_escaped(running: Running) -> None:
    metrics = Metrics()
    metrics.count("BREW", 'a"b\\c\nd', status=418, seconds=0.1)
    numbers = read(metrics.exposition(running.jobs).decode())
    assert at(numbers, "pliant_http_requests_total", method="other", route='a"b\\c\nd', status="418") == 1


def test_oldest_returns_when_the_first_queued_job_was_created(running: Running, http: httpx.Client) -> None:
    submit(http, name="first or later")
    submit(http, name="later")
    oldest = running.jobs.records.oldest(Status.QUEUED)
    assert oldest is not None
    made = [job.created_at for job in running.jobs.page(limit=200, statuses=[Status.QUEUED]).jobs]
    assert abs((oldest - min(made)).total_seconds()) < 0.002

"""A trace covers the request, the queue and the solver stages; with tracing off, OpenTelemetry is not imported."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import httpx
import pytest
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from pliant.solver.gallery import face
from pliant.worker import tracing
from pliant.worker.errors import InvalidSetting
from pliant.worker.execution import attempt
from serving import Running, npz, submit, until

INCOMING = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"


@pytest.fixture
def spans(monkeypatch: pytest.MonkeyPatch) -> Iterator[InMemorySpanExporter]:
    """Collect the spans of this process, whatever the settings."""
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(tracing, "configure", lambda *_, **__: None)
    monkeypatch.setattr(tracing, "finish", lambda: None)
    tracing.use(provider)
    yield exporter
    tracing.use(None)


def named(exporter: InMemorySpanExporter) -> dict[str, ReadableSpan]:
    return {each.name: each for each in exporter.get_finished_spans()}


def test_request_queue_and_solver_stages_share_one_trace(
    running: Running, http: httpx.Client, spans: InMemorySpanExporter
) -> None:
    sequence = face(4, 60)
    form = {"tracks": ("tracks.npz", npz(tracks=sequence.tracks.points)), "mesh": (None, "none"),
            "options": (None, '{"prior": "smooth", "max_reweightings": 2, "outputs": []}')}  # fmt: skip
    answer = http.post("/v1/jobs", files=form, headers={"traceparent": INCOMING})
    assert answer.status_code == 202, answer.text
    id = answer.json()["id"]
    stored = running.jobs.records.get(id)
    attempt.run(id, stored.attempt_id, settings=running.jobs.settings, worker="here")
    assert running.jobs.get(id).status == "succeeded", running.jobs.get(id).error
    until(lambda: "POST /v1/jobs" in named(spans))
    found = named(spans)
    assert {"attempt", "queued", "loading", "cameras", "reweight", "exporting"} <= set(found)
    assert {each.context.trace_id for each in found.values()} == {int(INCOMING.split("-")[1], 16)}
    request, work = found["POST /v1/jobs"], found["attempt"]
    assert request.parent.span_id == int(INCOMING.split("-")[2], 16)
    assert work.parent.span_id == request.context.span_id
    assert (work.attributes["pliant.job"], work.attributes["pliant.attempt"]) == (id, 1)
    assert request.attributes["http.response.status_code"] == 202
    stages = sorted(
        (each for each in found.values() if each.parent.span_id == work.context.span_id),
        key=lambda each: each.start_time,
    )
    assert stages[0].name == "queued"
    assert all(before.end_time <= after.start_time for before, after in pairwise(stages[1:]))


def test_health_checks_leave_no_spans(http: httpx.Client, spans: InMemorySpanExporter) -> None:
    http.get("/healthz")
    http.get("/v1/options")
    until(lambda: named(spans))
    assert set(named(spans)) == {"GET /v1/options"}


def test_without_tracing_a_job_has_no_trace(running: Running, http: httpx.Client) -> None:
    job = submit(http, name="untraced")
    assert running.jobs.records.get(job.id).trace is None
    assert tracing.traceparent() is None
    with tracing.span("nothing") as current:
        assert current is None


def test_missing_opentelemetry_names_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("opentelemetry.sdk.resources", "opentelemetry.sdk.trace", "opentelemetry.sdk.trace.export"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InvalidSetting, match=r"\.\[otel\]"):
        tracing.configure("console", service="test")
    tracing.configure("off", service="test")


@pytest.mark.parametrize("command", [["pliant.worker", "work"], ["pliant.worker", "reconcile"], ["pliant.cli", "work"]])
def test_no_worker_starts_without_opentelemetry(tmp_path: Path, command: list[str]) -> None:
    """It would fail every job that it takes."""
    blocked = tmp_path / "opentelemetry"
    blocked.mkdir()
    (blocked / "__init__.py").write_text("raise ImportError('not installed')")
    env = {**os.environ, "PYTHONPATH": str(tmp_path), "PLIANT_TRACING": "otlp", "PLIANT_DATA": str(tmp_path / "data")}
    env["PLIANT_REDIS_URL"] = "redis://127.0.0.1:9"
    ended = subprocess.run(
        [sys.executable, "-m", *command], env=env, capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode in (1, 3), ended.stderr
    assert "PLIANT_TRACING: expected off, or the extra otel" in ended.stderr


def test_console_spans_are_printed_even_if_stdout_is_redirected() -> None:
    script = (
        "from pliant.worker import tracing\n"
        "tracing.configure('console', service='test')\n"
        "with tracing.span('outer', answer=42):\n    assert tracing.traceparent()\n"
        "import os; os.dup2(os.open(os.devnull, os.O_WRONLY), 1)\n"  # as a job does with its output
        "tracing.finish()\n"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert '"name": "outer"' in ran.stdout
    assert '"pliant.answer": 42' in ran.stdout


def test_opentelemetry_is_not_imported_if_tracing_is_off() -> None:
    script = (
        "import sys\nfrom pliant.worker import tracing\ntracing.configure('off', service='test')\n"
        "with tracing.span('nothing'):\n    tracing.Stages().enter('cameras')\n"
        "print(any(name.startswith('opentelemetry') for name in sys.modules))"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False"

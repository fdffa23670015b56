"""fsck finds each kind of inconsistency, and nothing in consistent stores."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from pliant.schemas.job import Artifact, Interpretation, Problem
from pliant.schemas.options import Options
from pliant.worker.execution.workdir import working_directory
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.finished import Finished
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.maintenance.fsck import findings
from pliant.worker.records import Stored

NOW = datetime(2030, 1, 1, tzinfo=UTC)


@pytest.fixture
def submit(jobs: Jobs, inputs_file: Path, interpretation: Interpretation) -> Callable[[], Stored]:
    def make() -> Stored:
        id = jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id
        return jobs.records.get(id)

    return make


def claim(jobs: Jobs, stored: Stored) -> Stored:
    jobs.queue.remove(stored.attempt_id)
    return jobs.records.update(
        stored.job.id, lambda held: lifecycle.claim(held, attempt_id=held.attempt_id, worker="w", now=NOW)
    )


def succeed(jobs: Jobs, stored: Stored, file: Path, *, size: int) -> Stored:
    prefix = f"jobs/{stored.job.id}/{stored.attempt_id}/artifacts/"
    jobs.blobs.put(f"{prefix}report.json", file)
    artifact = Artifact(name="report.json", media_type="application/json", bytes=size, sha256="0" * 64)
    return jobs.records.update(
        stored.job.id,
        lambda held: lifecycle.succeed(
            held, Finished(metrics={}, outcome="converged", sentence="Converged.", warnings=(), artifacts=(artifact,)),
            attempt_id=held.attempt_id, prefix=prefix, now=NOW, retention=0,
        ),
    )  # fmt: skip


def test_consistent_jobs_in_every_status_give_no_finding(
    jobs: Jobs, submit: Callable[[], Stored], inputs_file: Path
) -> None:
    submit()
    running = claim(jobs, submit())
    working_directory(jobs.settings, running.attempt_id).mkdir(parents=True)
    jobs.blobs.put(f"jobs/{running.job.id}/{running.attempt_id}/artifacts/half.npz", inputs_file)
    jobs.cancel(claim(jobs, submit()).job.id)
    jobs.cancel(submit().job.id)
    succeed(jobs, claim(jobs, submit()), inputs_file, size=inputs_file.stat().st_size)
    failed = claim(jobs, submit())
    problem = Problem(title="t", status=500, detail="d.", code="internal_error")
    jobs.records.update(
        failed.job.id,
        lambda held: lifecycle.fail(held, attempt_id=held.attempt_id, problem=problem, now=NOW, retention=0),
    )
    assert findings(jobs, pause=0) == []


def test_every_kind_of_inconsistency_is_found(jobs: Jobs, submit: Callable[[], Stored], inputs_file: Path) -> None:
    def only(sentence: str) -> None:
        (found,) = findings(jobs, pause=0)
        assert sentence in found

    stored = submit()
    jobs.blobs.put("jobs/nobody/nobody-1/inputs.npz", inputs_file)
    only("jobs/nobody/nobody-1/inputs.npz belongs to no job")
    jobs.blobs.delete("jobs/nobody/")

    stale = f"jobs/{stored.job.id}/{stored.job.id}-0/artifacts/shapes.npz"
    jobs.blobs.put(stale, inputs_file)
    only("belongs to no current attempt")
    jobs.blobs.delete(stale)

    directory = working_directory(jobs.settings, "nobody-1")
    directory.mkdir(parents=True)
    only("belongs to no running attempt")
    directory.rmdir()

    jobs.queue.push("nobody", "nobody-1")
    only("nobody-1, which no queued job owns")
    jobs.queue.remove("nobody-1")

    jobs.queue.remove(stored.attempt_id)
    only("the queue does not hold it")
    jobs.queue.push(stored.job.id, stored.attempt_id)

    done = succeed(jobs, claim(jobs, submit()), inputs_file, size=5)
    only("report.json should have 5 bytes and has 3000000")
    jobs.records.update(done.job.id, lambda held: held.model_copy(update={"prefix": "elsewhere/"}))
    assert len(findings(jobs, pause=0)) == 2
    jobs.records.delete(done, at=NOW)
    jobs.records.forget_deleted(done.job.id)
    jobs.blobs.delete(f"jobs/{done.job.id}/")

    for update, sentence in (
        ({"finished_at": NOW}, "but finished_at is"),
        ({"error": Problem(title="t", status=500, detail="d.", code="c")}, "its error is"),
    ):
        sound = jobs.records.get(stored.job.id).job
        jobs.records.update(
            stored.job.id,
            lambda held, u=update: held.model_copy(update={"job": held.job.model_copy(update=u)}),  # type: ignore[misc]
        )
        only(sentence)
        jobs.records.update(stored.job.id, lambda held, job=sound: held.model_copy(update={"job": job}))  # type: ignore[misc]
    jobs.records.update(stored.job.id, lambda held: held.model_copy(update={"prefix": "p/"}))
    assert any("its results are stored under p/" in found for found in findings(jobs, pause=0))
    jobs.records.update(stored.job.id, lambda held: held.model_copy(update={"prefix": None}))

    upload = jobs.settings.uploads / "somebody" / "half"
    upload.mkdir(parents=True)
    only("Upload half holds nothing")
    upload.rmdir()

    jobs.blobs.delete(stored.inputs)
    only("has lost its inputs")


def test_a_change_in_progress_is_not_reported(
    jobs: Jobs, submit: Callable[[], Stored], monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = submit()
    jobs.queue.remove(stored.attempt_id)
    monkeypatch.setattr("time.sleep", lambda seconds: jobs.queue.push(stored.job.id, stored.attempt_id))
    assert findings(jobs) == []


def test_an_attempt_queued_twice_is_found(
    jobs: Jobs, submit: Callable[[], Stored], monkeypatch: pytest.MonkeyPatch
) -> None:
    attempt_id = submit().attempt_id
    monkeypatch.setattr(type(jobs.queue), "waiting", lambda self: [attempt_id, attempt_id])
    (found,) = findings(jobs, pause=0)
    assert found == f"The queue holds {attempt_id} 2 times."

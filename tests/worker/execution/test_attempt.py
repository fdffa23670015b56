"""An attempt as seen by the job process, on a simulated clock: intervals of progress and status."""

from __future__ import annotations

import errno
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pliant.schemas.job import Artifact, Interpretation, Progress, Status
from pliant.schemas.options import Options
from pliant.solver.errors import InvalidInput
from pliant.worker.errors import Interrupted, StoreUnavailable
from pliant.worker.execution.attempt import Attempt, limited_memory, run, work
from pliant.worker.execution.failures import problem_of
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.finished import Finished
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.processes.contained import run_contained
from pliant.worker.records import Stored
from pliant.worker.store.blobs import Blobs
from worker_house import SHORT, make_inputs

PROBLEM = problem_of(ValueError("unexpected"))


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    time = [0.0]
    monkeypatch.setattr("pliant.worker.execution.attempt.time", SimpleNamespace(monotonic=lambda: time[0]))
    return time


@pytest.fixture
def attempt(jobs: Jobs, now: list[float], inputs_file: Path, interpretation: Interpretation) -> Attempt:
    id = jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id
    attempt_id = jobs.records.get(id).attempt_id
    jobs.records.update(
        id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="w", now=datetime.now(UTC))
    )
    return Attempt(jobs=jobs, id=id, attempt_id=attempt_id, deadline=9.0)


def through(now: list[float], seconds: float, each: Callable[[], object]) -> None:
    """Call every hundredth of a second."""
    begin = now[0]
    for step in range(round(100 * seconds)):
        now[0] = begin + step / 100
        each()


def test_progress_is_written_at_most_twice_a_second(jobs: Jobs, attempt: Attempt, now: list[float]) -> None:
    moments: list[float] = []

    def report() -> None:
        attempt.report(Progress(stage="reweight", fraction=now[0] / 10, updated_at=datetime.now(UTC)))
        progress = jobs.get(attempt.id).progress
        assert progress is not None
        if progress.fraction == now[0] / 10:
            moments.append(now[0])

    through(now, 2.0, report)
    assert moments == pytest.approx([0.0, 0.5, 1.0, 1.5])


def test_a_cancel_is_noticed_within_a_quarter_of_a_second(jobs: Jobs, attempt: Attempt, now: list[float]) -> None:
    assert not attempt.should_stop()
    jobs.cancel(attempt.id)
    stopped: list[float] = []
    through(now, 0.5, lambda: stopped.append(now[0]) if attempt.should_stop() else None)
    assert stopped[0] == pytest.approx(0.25)
    attempt.conclude(None)
    assert jobs.get(attempt.id).status is Status.CANCELLED


def test_a_store_that_hangs_slows_a_job_down_by_at_most_a_quarter(
    attempt: Attempt, now: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    def hang(*_: object, **__: object) -> None:
        now[0] += 7.0
        raise StoreUnavailable("The job store", reason="TimeoutError")

    monkeypatch.setattr(type(attempt.jobs.records), "look", hang)
    monkeypatch.setattr(type(attempt.jobs.records), "update", hang)
    attempt.deadline = 1e6
    for _ in range(20_000):  # steps of 10 ms
        now[0] += 0.01
        attempt.report(Progress(stage="reweight", fraction=0.5, updated_at=datetime.now(UTC)))
        assert not attempt.should_stop()
    assert 200 < now[0] < 200 * 1.25 + 7


def test_a_film_job_that_fails_keeps_the_warnings_about_its_film(
    jobs: Jobs, attempt: Attempt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reconstruct_film(*_: object, on_warnings: Callable[[Sequence[str]], None], **__: object) -> Finished:
        on_warnings(["The film has a cut (at frame 10)."])
        raise InvalidInput("tracks_lost", field="film", expected="points", got="0", hint="Film slowly.")

    monkeypatch.setattr("pliant.worker.films.sources.is_source", lambda _: True)
    monkeypatch.setattr("pliant.worker.films.sources.open_source", lambda *_: None)
    monkeypatch.setattr("pliant.worker.execution.film.reconstruct_film", reconstruct_film)
    problem = work(attempt, jobs.records.get(attempt.id), tmp_path)
    assert attempt.conclude(problem) == "failed"
    assert jobs.get(attempt.id).warnings == ["The film has a cut (at frame 10)."]


def test_a_limit_of_memory_that_the_system_lacks_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def refuse(_: int, limits: tuple[int, int]) -> None:
        asked.append(limits[0])
        raise ValueError("current limit exceeds maximum limit")

    monkeypatch.setattr("pliant.worker.execution.attempt.resource.setrlimit", refuse)
    with limited_memory(1 << 35):
        assert asked == [1 << 35]


def test_an_attempt_stops_at_its_time_limit(attempt: Attempt, now: list[float]) -> None:
    assert not attempt.should_stop()
    now[0] = 9.0
    assert attempt.should_stop()


def test_a_finished_job_waits_for_an_unavailable_blob_store(
    jobs: Jobs, attempt: Attempt, now: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "report.json").write_text("{}")
    artifact = Artifact(name="report.json", media_type="application/json", bytes=2, sha256="0" * 64, description="")
    finished = Finished(metrics={}, outcome="converged", sentence="Done.", warnings=(), artifacts=(artifact,))
    put, away = jobs.blobs.put, [3]

    def sometimes(self: Blobs, key: str, file: Path, **more: str) -> int:
        if away[0]:
            away[0] -= 1
            raise StoreUnavailable("The blob store", reason="away")
        return put(key, file, **more)

    monkeypatch.setattr(Blobs, "put", sometimes)
    monkeypatch.setattr("pliant.worker.execution.monitor.time.sleep", lambda seconds: None)
    attempt.store(finished, tmp_path)
    assert f"{attempt.prefix}report.json" in jobs.blobs.sizes()
    away[0] = 1
    jobs.cancel(attempt.id)
    now[0] += 1
    with pytest.raises(Interrupted):
        attempt.store(finished, tmp_path)
    monkeypatch.setattr(Attempt, "should_stop", lambda self: False)
    monkeypatch.setattr("pliant.worker.execution.attempt.RETRY_SECONDS", -1.0)
    away[0] = 1
    with pytest.raises(StoreUnavailable):
        attempt.store(finished, tmp_path)


def test_the_log_is_complete_despite_an_outage_at_the_end(
    jobs: Jobs, attempt: Attempt, monkeypatch: pytest.MonkeyPatch
) -> None:
    append, away = jobs.records.append_log, [2]

    def sometimes(id: str, lines: Sequence[str]) -> None:
        if away[0]:
            away[0] -= 1
            raise StoreUnavailable("The job store", reason="away")
        append(id, lines)

    monkeypatch.setattr(jobs.records, "append_log", sometimes)
    monkeypatch.setattr("pliant.worker.execution.monitor.time.sleep", lambda seconds: None)
    attempt.log("Begun.")
    attempt.report(Progress(stage="reweight", fraction=0.5, updated_at=datetime.now(UTC)))
    attempt.log("Failed: why.")
    attempt.conclude(PROBLEM)
    assert [line.split(" ", 1)[1] for line in jobs.log(attempt.id).splitlines()] == ["Begun.", "Failed: why."]


def test_the_outcome_is_recorded_even_if_the_log_cannot_be_written(
    jobs: Jobs, attempt: Attempt, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(id: str, lines: Sequence[str]) -> None:
        raise StoreUnavailable("The job store", reason="away")

    monkeypatch.setattr(jobs.records, "append_log", never)
    monkeypatch.setattr("pliant.worker.execution.attempt.RETRY_SECONDS", -1.0)
    attempt.log("Failed: why.")
    attempt.conclude(PROBLEM)
    assert jobs.get(attempt.id).status is Status.FAILED


def test_a_line_logged_during_a_write_is_written_once(
    jobs: Jobs, attempt: Attempt, monkeypatch: pytest.MonkeyPatch
) -> None:
    append, logging = jobs.records.append_log, threading.Thread(target=attempt.log, args=("Second.",))

    def during(id: str, lines: Sequence[str]) -> None:
        append(id, lines)
        if not logging.ident:
            logging.start()
            logging.join(0.1)

    monkeypatch.setattr(jobs.records, "append_log", during)
    attempt.log("First.")
    attempt.report(Progress(stage="reweight", fraction=0.5, updated_at=datetime.now(UTC)))
    logging.join(10)
    attempt.conclude(PROBLEM)
    assert [line.split(" ", 1)[1] for line in jobs.log(attempt.id).splitlines()] == ["First.", "Second."]


def test_a_new_stage_is_reported_at_once(jobs: Jobs, attempt: Attempt, now: list[float]) -> None:
    """A job that waits for its blob store reports no more: its record must not stay at the previous stage."""
    for stage in ("reweight", "finish", "exporting"):
        now[0] += 0.01
        attempt.report(Progress(stage=stage, fraction=0.5, updated_at=datetime.now(UTC)))
        progress = jobs.get(attempt.id).progress
        assert progress is not None
        assert progress.stage == stage


def test_progress_is_repeated_while_files_are_fetched_and_stored(
    jobs: Jobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = make_inputs(tmp_path / "in.npz", frames=4, points=30).interpretation
    options = Options(method="pseudo_inverse", outputs=(), refine_rotations=False)
    id = jobs.submit(tmp_path / "in.npz", Submission(options=options), interpretation=read)[0].id
    stored = jobs.records.get(id)
    told: list[Progress] = []
    during: dict[str, list[Progress]] = {}
    monkeypatch.setattr("pliant.worker.execution.progress.TICK", 0.01)
    monkeypatch.setattr(Attempt, "report", lambda self, progress: told.append(progress))

    def slowly(name: str) -> Callable[..., object]:
        call = getattr(Blobs, name)

        def wait(self: Blobs, *given: object, **more: object) -> object:
            before, patience = len(told), threading.Event()
            while len(told) < before + 2:
                patience.wait(0.01)
            during[name] = told[before:]
            return call(self, *given, **more)

        return wait

    monkeypatch.setattr(Blobs, "fetch", slowly("fetch"))
    monkeypatch.setattr(Blobs, "put", slowly("put"))
    attempt = Attempt(jobs=jobs, id=id, attempt_id=stored.attempt_id, deadline=float("inf"))
    monkeypatch.setattr(Attempt, "should_stop", lambda self: False)
    end = work(attempt, stored, tmp_path)
    assert isinstance(end, Finished)
    assert {(each.stage, each.fraction) for each in during["fetch"]} == {("loading", 0.0)}
    assert {(each.fraction, each.seconds_left) for each in during["put"]} == {(1.0, 0.0)}


def test_a_job_runs_even_if_the_reply_to_its_claim_is_lost(
    jobs: Jobs, tmp_path: Path, interpretation: Interpretation, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "inputs.npz"
    make_inputs(file, frames=4, points=20)
    id = jobs.submit(file, Submission(options=SHORT), interpretation=interpretation)[0].id
    attempt_id = jobs.records.get(id).attempt_id
    replace, lost = jobs.records.replace, []

    def lose_the_first(before: Stored, after: Stored) -> bool:
        written = replace(before, after)
        if not lost:
            lost.append(after)
            raise StoreUnavailable("The job store", reason="ConnectionError")
        return written

    monkeypatch.setattr(jobs.records, "replace", lose_the_first)
    monkeypatch.setattr(Jobs, "open", lambda _: jobs)
    run(id, attempt_id, settings=jobs.settings, worker="w")
    assert lost[0].job.status is Status.RUNNING
    job = jobs.get(id)
    assert (job.status, job.attempt) == (Status.SUCCEEDED, 1), job.error


def test_a_scratch_folder_that_cannot_be_made_fails_the_job_with_its_cause(
    jobs: Jobs, inputs_file: Path, interpretation: Interpretation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Jobs, "open", lambda _: jobs)
    id = jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id
    work_folder = jobs.settings.data / "work"
    if work_folder.exists():
        work_folder.rmdir()
    work_folder.write_text("a file in place of the folder")
    run(id, jobs.records.get(id).attempt_id, settings=jobs.settings, worker="w")
    job = jobs.get(id)
    assert job.error is not None
    assert job.error.code == "storage_failed"
    assert "NotADirectoryError" in jobs.log(id)


def test_a_job_whose_file_was_lost_names_the_setting(
    jobs: Jobs,
    inputs_file: Path,
    interpretation: Interpretation,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Those of another job are there, so the worker has the right blob store."""
    caplog.set_level("INFO")
    monkeypatch.setattr(Jobs, "open", lambda _: jobs)
    jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)
    id = jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id
    jobs.blobs.delete(jobs.records.get(id).inputs)
    run(id, jobs.records.get(id).attempt_id, settings=jobs.settings, worker="w")
    job = jobs.get(id)
    assert job.error is not None
    assert (job.error.code, job.error.retryable) == ("storage_failed", True)
    assert "Check that PLIANT_BLOB_URL names the same one for the worker" in job.error.detail
    last = caplog.records[-1]
    assert last.getMessage() == f"job {id}: attempt 1 ended: failed (storage_failed)"
    assert (last.__dict__["outcome"], last.__dict__["code"]) == ("failed", "storage_failed")


def test_a_full_disk_is_named_and_freed_before_the_failure_is_recorded(
    jobs: Jobs, tmp_path: Path, interpretation: Interpretation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a disk that they share, the store of records cannot record anything while the files of the job fill it."""
    held: list[list[str]] = []
    written = jobs.records.update

    def update(id: str, change: Callable[[Stored], Stored]) -> Stored:
        kept = written(id, change)
        if kept.job.status is Status.FAILED:
            held.append(sorted(path.name for path in (jobs.settings.work / kept.attempt_id).iterdir()))
        return kept

    def fill(_: object, __: object, results: Path, **___: object) -> Finished:
        results.mkdir()
        (results / "shapes.npz").write_bytes(bytes(1000))
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Jobs, "open", lambda _: jobs)
    monkeypatch.setattr(jobs.records, "update", update)
    monkeypatch.setattr("pliant.worker.execution.pipeline.reconstruct", fill)
    make_inputs(tmp_path / "inputs.npz", frames=6, points=40)
    id = jobs.submit(tmp_path / "inputs.npz", Submission(options=Options()), interpretation=interpretation)[0].id
    run(id, jobs.records.get(id).attempt_id, settings=jobs.settings, worker="w")
    job = jobs.get(id)
    assert job.error is not None
    assert job.error.code == "storage_failed"
    assert "(No space left on device). Free disk space" in job.error.detail
    assert held == [["output.log"]]


FULL = """
import errno, sys
from pliant.worker.processes.contained import serve
def handle(request):
    raise OSError(errno.ENOSPC, "No space left on device")
sys.exit(serve(handle))
"""


def test_a_full_disk_in_a_contained_process_is_an_error_of_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    popen = subprocess.Popen

    def started(command: list[str], **more: Any) -> subprocess.Popen[bytes]:
        return popen([command[0], "-c", FULL, command[-1]], **more)

    monkeypatch.setattr("pliant.worker.processes.contained.subprocess.Popen", started)
    with pytest.raises(OSError, match="No space left on device") as caught:
        run_contained("any", {}, seconds=30)
    assert problem_of(caught.value).code == "storage_failed"


def test_a_memory_limit_above_the_limit_of_the_process_has_no_effect() -> None:
    script = (
        "import resource; from pliant.worker.execution.attempt import limited_memory\n"
        "resource.setrlimit(resource.RLIMIT_AS, (1 << 36, 1 << 36))\n"
        "with limited_memory(1 << 37): print(resource.getrlimit(resource.RLIMIT_AS)[0] == 1 << 36)\n"
        "with limited_memory(1 << 35): print(resource.getrlimit(resource.RLIMIT_AS)[0] == 1 << 35)\n"
        "print(resource.getrlimit(resource.RLIMIT_AS)[0] == 1 << 36)"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert ran.stdout.split() == ["True"] * 3

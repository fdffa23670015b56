"""The reconciler on a simulated clock: lost jobs, jobs missing from the queue, expiry, stray files."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from pliant.schemas.job import Interpretation, Problem, Status
from pliant.schemas.options import Options
from pliant.worker.errors import StoreUnavailable, UnknownJob
from pliant.worker.execution.workdir import clean_up, output_tail, working_directory
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.maintenance.fsck import findings
from pliant.worker.maintenance.reconciler import IdleTimer, Reconciler
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.uploads.service import Capacity, Uploads
from reconciler_world import World


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


@pytest.fixture
def submit(inputs_file: Path, interpretation: Interpretation) -> Callable[[World], str]:
    return lambda world: (
        world.jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id
    )


def test_a_job_without_heartbeats_is_requeued_then_fails(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    old = world.claim(id)
    working_directory(world.jobs.settings, old).mkdir(parents=True)
    world.pass_seconds(5)
    assert world.jobs.get(id).status is Status.RUNNING, "five seconds of watching begin with the first look"
    world.pass_seconds(1)
    assert world.jobs.get(id).status is Status.QUEUED
    assert not working_directory(world.jobs.settings, old).exists()
    (fresh,) = world.jobs.queue.waiting()
    assert fresh != old
    world.claim(id)
    world.pass_seconds(7)
    job = world.jobs.get(id)
    assert (job.status, job.attempt) == (Status.FAILED, 2)
    assert job.error is not None
    assert (job.error.code, job.error.retryable) == ("worker_lost", True)


def test_a_cancelled_job_without_heartbeats_is_cancelled(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    world.claim(id)
    world.jobs.cancel(id)
    world.pass_seconds(7)
    assert world.jobs.get(id).status is Status.CANCELLED


def test_heartbeats_keep_a_job_running(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    attempt_id = world.claim(id)
    world.pass_seconds(30, meanwhile=lambda: world.jobs.records.beat(id, attempt_id))
    assert world.jobs.get(id).status is Status.RUNNING


def test_an_outage_or_a_clock_jump_loses_no_job(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    attempt_id = world.claim(id)
    world.pass_seconds(2)
    world.monotonic += 600  # neither checks nor heartbeats were possible
    world.now += timedelta(days=1)
    world.pass_seconds(1)
    assert world.jobs.get(id).status is Status.RUNNING
    world.jobs.records.beat(id, attempt_id)
    world.pass_seconds(4)
    assert world.jobs.get(id).status is Status.RUNNING


def test_a_job_missing_from_the_queue_is_queued_again(world: World, submit: Callable[[World], str]) -> None:
    id, other = submit(world), submit(world)
    attempt_id = world.jobs.records.get(id).attempt_id
    world.jobs.queue.remove(attempt_id)
    world.pass_seconds(5)
    assert world.jobs.records.get(id).attempt_id != attempt_id, "the old delivery, should it turn up, is void"
    assert world.jobs.queue.waiting() == [world.jobs.records.get(each).attempt_id for each in (id, other)], (
        "before all the others"
    )


def test_only_expired_jobs_are_removed(world: World, submit: Callable[[World], str]) -> None:
    queued, running, early, late = (submit(world) for _ in range(4))
    attempt_id = world.claim(running)
    world.jobs.cancel(early)
    beat = lambda: world.jobs.records.beat(running, attempt_id)  # noqa: E731
    world.pass_seconds(40, meanwhile=beat)
    world.jobs.cancel(late)
    world.pass_seconds(52, meanwhile=beat)
    with pytest.raises(UnknownJob):
        world.jobs.get(early)
    assert {job.id for job in world.jobs.page().jobs} == {queued, running, late}
    assert world.jobs.get(late).expires_at is not None
    assert all(early not in key for key, _ in world.jobs.blobs.list("jobs/"))


def note_what_retention_reads(world: World, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    read: list[str] = []
    page = type(world.jobs).page

    def noted(jobs: Jobs, **given: Any) -> Any:
        found = page(jobs, **given)
        read.extend(job.id for job in found.jobs if "cursor" in given)  # not those that others read
        return found

    monkeypatch.setattr(type(world.jobs), "page", noted)
    return read


def test_records_that_are_kept_for_ever_are_read_once_an_hour(
    world: World, submit: Callable[[World], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    world.jobs = dataclasses.replace(world.jobs, settings=dataclasses.replace(world.jobs.settings, retention=0))
    world.reconciler.jobs = world.reconciler.retention.jobs = world.jobs
    read = note_what_retention_reads(world, monkeypatch)
    kept = submit(world)
    world.jobs.cancel(kept)
    world.pass_seconds(100)
    assert read == []
    world.monotonic += 3600
    world.now += timedelta(hours=1)
    world.pass_seconds(1)
    assert read == [kept]


def test_records_that_cannot_have_expired_are_read_once_an_hour(
    world: World, submit: Callable[[World], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading a hundred thousand records takes longer than the pause between two checks."""
    read = note_what_retention_reads(world, monkeypatch)
    kept = submit(world)
    world.jobs.cancel(kept)
    stored = world.jobs.records.get(kept)
    late = stored.job.model_copy(update={"expires_at": world.now + timedelta(days=9)})  # of a longer period
    world.jobs.records.replace(stored, stored.model_copy(update={"job": late, "version": stored.version + 1}))
    world.pass_seconds(35)
    assert read == []  # it is younger than the retention of 60 s
    world.pass_seconds(60)
    assert set(read) == {kept}
    early = submit(world)
    world.jobs.cancel(early)
    stored = world.jobs.records.get(early)
    soon = stored.job.model_copy(update={"created_at": world.now + timedelta(days=1), "expires_at": world.now})
    world.jobs.records.delete(stored, at=world.now)
    world.jobs.records.create(stored.model_copy(update={"job": soon}))  # looks younger than it is
    world.pass_seconds(60)
    assert world.jobs.get(early).status is Status.CANCELLED
    world.monotonic += 3600
    world.now += timedelta(hours=1)
    world.pass_seconds(1)
    with pytest.raises(UnknownJob):
        world.jobs.get(early)


def test_a_new_job_under_an_expired_ones_id_is_kept(
    world: World, submit: Callable[[World], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    id = submit(world)
    world.jobs.cancel(id)
    page = type(world.jobs).page

    def replaced(jobs: Jobs, **given: Any) -> Any:
        """Delete the job and submit another one once the page is read."""
        found = page(jobs, **given)
        if jobs.records.get(id).job.created_at == found.jobs[0].created_at:
            stored = jobs.records.get(id)
            jobs.delete(id)
            later = stored.job.model_copy(update={"created_at": world.now, "expires_at": world.now + timedelta(days=9)})
            jobs.records.create(stored.model_copy(update={"job": later}))
        return found

    world.now += timedelta(days=1)
    monkeypatch.setattr(type(world.jobs), "page", replaced)
    world.reconciler.retention._expire()
    assert world.jobs.get(id).status is Status.CANCELLED
    monkeypatch.undo()
    world.now += timedelta(days=10)
    world.reconciler.retention._expire()
    with pytest.raises(UnknownJob):
        world.jobs.get(id)


def test_without_retention_nothing_expires(world: World, submit: Callable[[World], str]) -> None:
    world.jobs = dataclasses.replace(world.jobs, settings=dataclasses.replace(world.jobs.settings, retention=0))
    world.reconciler.jobs = world.jobs
    id = submit(world)
    assert world.jobs.cancel(id).expires_at is None
    world.now += timedelta(days=10_000)
    world.pass_seconds(40)
    assert world.jobs.get(id).status is Status.CANCELLED


def test_files_that_belong_to_no_job_are_removed_once_old(
    world: World, submit: Callable[[World], str], tmp_path: Path
) -> None:
    file = tmp_path / "some-inputs.npz"
    id = submit(world)
    attempt_id = world.claim(id)
    wanted = {world.jobs.records.get(id).inputs, f"jobs/{id}/{attempt_id}/artifacts/shapes.npz"}
    stray = {f"jobs/{id}/{id}-000000000000/artifacts/shapes.npz", "jobs/nobody/nobody-1/inputs.npz"}
    for key in (wanted | stray) - {world.jobs.records.get(id).inputs}:
        world.jobs.blobs.put(key, file)
    beat = lambda: world.jobs.records.beat(id, attempt_id)  # noqa: E731

    def sweep_at(moment: datetime) -> set[str]:
        world.now = moment
        world.monotonic += 3600
        world.pass_seconds(1, meanwhile=beat)
        return {key for key, _ in world.jobs.blobs.list("jobs/")}

    unknown = {"jobs/nobody/nobody-1/inputs.npz"}
    assert sweep_at(datetime.now(UTC) + timedelta(hours=5)) == wanted | unknown
    assert sweep_at(datetime.now(UTC) + timedelta(hours=7)) == wanted


def test_temporary_files_of_killed_processes_are_removed_with_the_stray_ones(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[datetime] = []
    monkeypatch.setattr(Blobs, "clear_unfinished", lambda self, *, before: asked.append(before))
    world.monotonic += 3600
    world.pass_seconds(1)
    assert asked == [world.now - timedelta(hours=6)]


def test_results_without_a_record_are_kept_and_named(
    world: World, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As with the PLIANT_BLOB_URL of another installation, or after a loss of the records: everything was removed at once."""
    (tmp_path / "file").write_text("x")
    for name in ("inputs.npz", "artifacts/shapes.npz"):
        world.jobs.blobs.put(f"jobs/theirs/theirs-1/{name}", tmp_path / "file")
    world.now, world.monotonic = datetime.now(UTC) + timedelta(days=1), world.monotonic + 3600
    world.pass_seconds(1)
    assert len(world.jobs.blobs.list("jobs/theirs/")) == 2
    assert "the files of 1 job(s) with results but without a record are kept, for example theirs" in caplog.text


def test_scratch_directories_of_ended_attempts_are_removed(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    attempt_id = world.claim(id)
    running, over, just_over = (
        working_directory(world.jobs.settings, each) for each in (attempt_id, f"{id}-0", f"{id}-1")
    )
    world.now = datetime.now(UTC)
    for directory in (running, over, just_over):
        directory.mkdir(parents=True)
    for directory in (running, over):
        os.utime(directory, (0, 0))
    world.pass_seconds(31, meanwhile=lambda: world.jobs.records.beat(id, attempt_id))
    assert [directory.exists() for directory in (running, over, just_over)] == [True, False, True]


def test_files_stored_by_a_killed_attempt_are_removed(
    world: World, submit: Callable[[World], str], tmp_path: Path
) -> None:
    id = submit(world)
    attempt_id = world.claim(id)
    half = f"jobs/{id}/{attempt_id}/artifacts/shapes.npz"
    world.jobs.blobs.put(half, tmp_path / "some-inputs.npz")
    world.pass_seconds(31, meanwhile=lambda: world.jobs.records.beat(id, attempt_id))
    assert half in dict(world.jobs.blobs.list("jobs/"))
    problem = Problem(title="t", status=503, detail="d.", code="worker_lost")
    world.jobs.records.update(
        id, lambda held: lifecycle.fail(held, attempt_id=attempt_id, problem=problem, now=world.now, retention=0)
    )
    assert any("belongs to no current attempt" in each for each in findings(world.jobs, pause=0))
    world.pass_seconds(1)
    assert findings(world.jobs, pause=0) == []
    assert [key for key, _ in world.jobs.blobs.list("jobs/")] == [world.jobs.records.get(id).inputs]


def test_files_stored_by_an_attempt_are_removed_if_its_worker_is_lost(
    world: World, submit: Callable[[World], str], tmp_path: Path
) -> None:
    id = submit(world)
    half = f"jobs/{id}/{world.claim(id)}/artifacts/shapes.npz"
    world.jobs.blobs.put(half, tmp_path / "some-inputs.npz")
    world.pass_seconds(31)
    assert world.jobs.get(id).status is Status.QUEUED
    assert [key for key, _ in world.jobs.blobs.list("jobs/")] == [world.jobs.records.get(id).inputs]
    assert findings(world.jobs, pause=0) == []


def test_the_reconciler_survives_an_unavailable_store(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def tick(self: Reconciler) -> None:
        calls.append(self)
        raise StoreUnavailable("The job store", reason="ConnectionError")

    monkeypatch.setattr(Reconciler, "tick", tick)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    world.reconciler.run(lambda: len(calls) == 3)
    assert len(calls) == 3


def test_silent_time_counts_only_while_the_heartbeat_is_unchanged() -> None:
    still = IdleTimer()
    assert still.look({"a": 1}, 5.0) == {"a": 0.0}
    assert still.look({"a": 1, "b": 1}, 2.0) == {"a": 2.0, "b": 0.0}
    assert still.look({"a": 2, "b": 1}, 2.0) == {"a": 0.0, "b": 2.0}
    assert still.look({"b": 1}, 1.0) == {"b": 3.0}
    assert still.look({"a": 2}, 1.0) == {"a": 0.0}


def test_the_last_100_lines_of_output_are_read(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path)
    assert output_tail(settings, "t-1") == []
    directory = working_directory(settings, "t-1")
    directory.mkdir(parents=True)
    (directory / "output.log").write_text("".join(f"line {number}\n" for number in range(5000)))
    words = output_tail(settings, "t-1")
    assert (len(words), words[-1]) == (100, "line 4999")
    clean_up(settings, "t-1")
    clean_up(settings, "t-1")
    assert not directory.exists()


def test_expired_uploads_are_removed(world: World) -> None:
    uploads = Uploads.open(world.jobs.settings)
    for id in ("old", "young"):
        with uploads.write(id, offset=0, length=None, capacity=Capacity(max_bytes=9)) as writer:
            writer.write(b"x")
        (file,) = uploads.directory.glob(f"*/{id}/part")
        moment = world.now.timestamp() - (uploads.expiry if id == "old" else uploads.expiry - 3600)
        os.utime(file, (moment, moment))
    world.pass_seconds(31)
    assert uploads.find("old") is None
    assert uploads.find("young") is not None


@pytest.mark.parametrize("jump", [timedelta(days=365), timedelta(days=-365)])
def test_a_clock_jump_of_a_year_loses_nothing(
    world: World, jump: timedelta, inputs_file: Path, interpretation: Interpretation
) -> None:
    def submit() -> str:
        return world.jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id

    done, busy, waiting = submit(), submit(), submit()
    world.claim(done)
    world.jobs.cancel(done)
    attempt_id = world.jobs.records.get(done).attempt_id
    world.jobs.records.update(
        done, lambda held: lifecycle.stop(held, attempt_id=attempt_id, now=world.now, retention=60.0)
    )
    attempt_id = world.claim(busy)
    world.pass_seconds(2, meanwhile=lambda: world.jobs.records.beat(busy, attempt_id))
    world.now += jump
    world.pass_seconds(70, meanwhile=lambda: world.jobs.records.beat(busy, attempt_id))
    assert world.jobs.get(done).status is Status.CANCELLED, "held, although by the new clock its time may be over"
    assert (world.jobs.get(busy).status, world.jobs.get(busy).attempt) == (Status.RUNNING, 1)
    assert world.jobs.get(waiting).place_in_queue == 0
    assert findings(world.jobs, pause=0) == []
    world.now -= jump  # corrected
    world.pass_seconds(3700, meanwhile=lambda: world.jobs.records.beat(busy, attempt_id))
    with pytest.raises(UnknownJob):
        world.jobs.get(done)
    assert world.jobs.get(busy).attempt == 1


def test_files_stored_late_by_a_stale_attempt_are_removed(
    world: World, submit: Callable[[World], str], tmp_path: Path
) -> None:
    id = submit(world)
    old = world.claim(id)
    world.pass_seconds(7)
    fresh = world.claim(id)
    stop = partial(lifecycle.stop, attempt_id=fresh, now=world.now, retention=60.0)
    (tmp_path / "late").write_text("late")
    world.jobs.cancel(id)
    world.jobs.records.update(id, stop)
    world.pass_seconds(2)
    world.jobs.blobs.put(f"jobs/{id}/{old}/artifacts/shapes.npz", tmp_path / "late")
    assert findings(world.jobs, pause=0) != []
    world.pass_seconds(31)
    assert findings(world.jobs, pause=0) == []


def test_files_of_a_deleted_job_are_removed_once_the_blob_store_is_back(
    world: World, submit: Callable[[World], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    id = submit(world)
    world.jobs.cancel(id)
    world.now = datetime.now(UTC) + timedelta(seconds=1)  # the blob store has its own clock
    with monkeypatch.context() as away:
        away.setattr(Blobs, "delete", refuse)
        world.jobs.delete(id)
    with pytest.raises(UnknownJob):
        world.jobs.get(id)
    assert list(world.jobs.records.deleted()) == [id]
    assert len(world.jobs.blobs.list()) == 1
    world.pass_seconds(31)
    assert world.jobs.blobs.list() == []
    assert world.jobs.records.deleted() == {}


def refuse(*_: object) -> None:
    raise StoreUnavailable("The blob store", reason="away")

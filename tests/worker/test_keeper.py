"""The keeper, on a clock of our own: what counts as lost, what as forgotten, what expires, and what never does."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from pliant.client.options import Options
from pliant.client.schemas import Interpretation, Problem, Status
from pliant.worker import lifecycle
from pliant.worker.audit import findings
from pliant.worker.blobs import Blobs
from pliant.worker.errors import StoreUnavailable, UnknownJob
from pliant.worker.files import clean_up, last_words, working_directory
from pliant.worker.jobs import Jobs
from pliant.worker.keeper import Keeper, Stillness
from pliant.worker.memory import MemoryQueue, MemoryRecords
from pliant.worker.settings import Settings
from pliant.worker.uploads import Room, Uploads


class World:
    """Jobs in memory, two clocks that we turn, a keeper."""

    def __init__(self, data: Path, **settings: object) -> None:
        self.now = datetime(2030, 1, 1, tzinfo=UTC)
        self.monotonic = 1000.0
        self.jobs = Jobs(
            records=MemoryRecords(),
            blobs=Blobs.open("memory:///"),
            queue=MemoryQueue(),
            settings=Settings(data=data, lost_after=5.0, retention=60.0, max_attempts=2, **settings),  # type: ignore[arg-type]
            clock=lambda: self.now,
        )
        self.keeper = Keeper(jobs=self.jobs, clock=lambda: self.monotonic)
        self.keeper.tick()

    def pass_seconds(self, seconds: float, *, meanwhile: Callable[[], object] = lambda: None) -> None:
        for _ in range(round(seconds)):
            self.monotonic += 1
            self.now += timedelta(seconds=1)
            meanwhile()
            self.keeper.tick()

    def claim(self, id: str) -> str:
        token = self.jobs.records.get(id).token
        self.jobs.queue.remove(token)
        self.jobs.records.update(id, lambda held: lifecycle.claim(held, token=token, worker="w", now=self.now))
        return token


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


@pytest.fixture
def submit(inputs_file: Path, interpretation: Interpretation) -> Callable[[World], str]:
    return lambda world: world.jobs.submit(inputs_file, options=Options(), interpretation=interpretation).id


def test_a_job_whose_worker_falls_silent_is_queued_again_then_fails(
    world: World, submit: Callable[[World], str]
) -> None:
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


def test_a_cancelled_job_whose_worker_falls_silent_is_cancelled(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    world.claim(id)
    world.jobs.cancel(id)
    world.pass_seconds(7)
    assert world.jobs.get(id).status is Status.CANCELLED


def test_signs_of_life_keep_a_job(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    token = world.claim(id)
    world.pass_seconds(30, meanwhile=lambda: world.jobs.records.beat(id, token))
    assert world.jobs.get(id).status is Status.RUNNING


def test_neither_an_outage_nor_a_jumping_clock_loses_a_job(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    token = world.claim(id)
    world.pass_seconds(2)
    world.monotonic += 600  # nobody could look, and nobody could give a sign of life
    world.now += timedelta(days=1)
    world.pass_seconds(1)
    assert world.jobs.get(id).status is Status.RUNNING
    world.jobs.records.beat(id, token)
    world.pass_seconds(4)
    assert world.jobs.get(id).status is Status.RUNNING


def test_a_queued_job_that_the_queue_does_not_hold_is_queued_again(
    world: World, submit: Callable[[World], str]
) -> None:
    id, other = submit(world), submit(world)
    token = world.jobs.records.get(id).token
    world.jobs.queue.remove(token)
    world.pass_seconds(5)
    assert world.jobs.records.get(id).token != token, "the old delivery, should it turn up, is void"
    assert world.jobs.queue.waiting() == [world.jobs.records.get(each).token for each in (id, other)], (
        "before all the others"
    )


def test_only_what_has_expired_is_removed(world: World, submit: Callable[[World], str]) -> None:
    queued, running, early, late = (submit(world) for _ in range(4))
    token = world.claim(running)
    world.jobs.cancel(early)
    beat = lambda: world.jobs.records.beat(running, token)  # noqa: E731
    world.pass_seconds(40, meanwhile=beat)
    world.jobs.cancel(late)
    world.pass_seconds(52, meanwhile=beat)
    with pytest.raises(UnknownJob):
        world.jobs.get(early)
    assert {job.id for job in world.jobs.page().jobs} == {queued, running, late}
    assert world.jobs.get(late).expires_at is not None
    assert all(early not in key for key, _ in world.jobs.blobs.list("jobs/"))


def test_without_retention_nothing_expires(world: World, submit: Callable[[World], str]) -> None:
    world.jobs = dataclasses.replace(world.jobs, settings=dataclasses.replace(world.jobs.settings, retention=0))
    world.keeper.jobs = world.jobs
    id = submit(world)
    assert world.jobs.cancel(id).expires_at is None
    world.now += timedelta(days=10_000)
    world.pass_seconds(40)
    assert world.jobs.get(id).status is Status.CANCELLED


def test_files_of_no_job_are_removed_once_they_are_old(
    world: World, submit: Callable[[World], str], tmp_path: Path
) -> None:
    file = tmp_path / "some-inputs.npz"
    id = submit(world)
    token = world.claim(id)
    wanted = {world.jobs.records.get(id).inputs, f"jobs/{id}/{token}/artifacts/shapes.npz"}
    stray = {f"jobs/{id}/{id}-000000000000/artifacts/shapes.npz", "jobs/nobody/nobody-1/inputs.npz"}
    for key in (wanted | stray) - {world.jobs.records.get(id).inputs}:
        world.jobs.blobs.put(key, file)
    beat = lambda: world.jobs.records.beat(id, token)  # noqa: E731

    def sweep_at(moment: datetime) -> set[str]:
        world.now = moment
        world.monotonic += 3600
        world.pass_seconds(1, meanwhile=beat)
        return {key for key, _ in world.jobs.blobs.list("jobs/")}

    unknown = {"jobs/nobody/nobody-1/inputs.npz"}
    assert sweep_at(datetime.now(UTC) + timedelta(hours=5)) == wanted | unknown
    assert sweep_at(datetime.now(UTC) + timedelta(hours=7)) == wanted


def test_working_files_of_attempts_that_are_over_are_removed(world: World, submit: Callable[[World], str]) -> None:
    id = submit(world)
    token = world.claim(id)
    running, over, just_over = (working_directory(world.jobs.settings, each) for each in (token, f"{id}-0", f"{id}-1"))
    world.now = datetime.now(UTC)
    for directory in (running, over, just_over):
        directory.mkdir(parents=True)
    for directory in (running, over):
        os.utime(directory, (0, 0))
    world.pass_seconds(31, meanwhile=lambda: world.jobs.records.beat(id, token))
    assert [directory.exists() for directory in (running, over, just_over)] == [True, False, True]


def test_what_a_killed_attempt_had_uploaded_is_removed(
    world: World, submit: Callable[[World], str], tmp_path: Path
) -> None:
    id = submit(world)
    token = world.claim(id)
    half = f"jobs/{id}/{token}/artifacts/shapes.npz"
    world.jobs.blobs.put(half, tmp_path / "some-inputs.npz")
    world.pass_seconds(31, meanwhile=lambda: world.jobs.records.beat(id, token))
    assert half in dict(world.jobs.blobs.list("jobs/"))
    problem = Problem(title="t", status=503, detail="d.", code="worker_lost")
    world.jobs.records.update(
        id, lambda held: lifecycle.fail(held, token=token, problem=problem, now=world.now, retention=0)
    )
    assert any("belongs to no attempt" in each for each in findings(world.jobs, settle=0))
    world.pass_seconds(1)
    assert findings(world.jobs, settle=0) == []
    assert [key for key, _ in world.jobs.blobs.list("jobs/")] == [world.jobs.records.get(id).inputs]


def test_a_store_that_is_away_is_waited_for(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def tick(self: Keeper) -> None:
        calls.append(self)
        raise StoreUnavailable("The job store", reason="ConnectionError")

    monkeypatch.setattr(Keeper, "tick", tick)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    world.keeper.run(lambda: len(calls) == 3)
    assert len(calls) == 3


def test_stillness_counts_only_between_two_looks_at_the_same_thing() -> None:
    still = Stillness()
    assert still.look({"a": 1}, 5.0) == {"a": 0.0}
    assert still.look({"a": 1, "b": 1}, 2.0) == {"a": 2.0, "b": 0.0}
    assert still.look({"a": 2, "b": 1}, 2.0) == {"a": 0.0, "b": 2.0}
    assert still.look({"b": 1}, 1.0) == {"b": 3.0}
    assert still.look({"a": 2}, 1.0) == {"a": 0.0}


def test_last_words_are_the_end_of_what_was_written(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path)
    assert last_words(settings, "t-1") == []
    directory = working_directory(settings, "t-1")
    directory.mkdir(parents=True)
    (directory / "output.log").write_text("".join(f"line {number}\n" for number in range(5000)))
    words = last_words(settings, "t-1")
    assert (len(words), words[-1]) == (100, "line 4999")
    clean_up(settings, "t-1")
    clean_up(settings, "t-1")
    assert not directory.exists()


def test_it_removes_uploads_that_have_expired(world: World) -> None:
    uploads = Uploads.open(world.jobs.settings)
    for id in ("old", "young"):
        with uploads.write(id, offset=0, length=None, room=Room(max_bytes=9)) as writer:
            writer.write(b"x")
        (file,) = uploads.directory.glob(f"*/{id}/part")
        moment = world.now.timestamp() - (uploads.expiry if id == "old" else uploads.expiry - 3600)
        os.utime(file, (moment, moment))
    world.pass_seconds(31)
    assert uploads.find("old") is None
    assert uploads.find("young") is not None


def test_no_more_of_an_owners_jobs_run_than_may_and_the_next_begins_when_one_ends(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=2)

    def made(owner: str) -> str:
        jobs = world.jobs.of(owner)
        world.now += timedelta(milliseconds=10)
        return jobs.submit(inputs_file, options=Options(), interpretation=interpretation).id

    def waiting() -> list[str]:
        return [token.rpartition("-")[0] for token in world.jobs.queue.waiting()]

    adas = [made("ada") for _ in range(5)]
    bobs = [made("bob")]
    assert waiting() == [*adas[:2], *bobs]
    world.pass_seconds(30)
    assert waiting() == [*adas[:2], *bobs], "what is held back is not taken for forgotten"
    assert findings(world.jobs, settle=0) == []
    tokens = [world.claim(adas[0]), world.claim(adas[1])]

    def alive() -> None:
        for id, token in zip(adas, tokens, strict=False):
            world.jobs.records.beat(id, token)

    world.pass_seconds(10, meanwhile=alive)
    assert waiting() == bobs
    world.jobs.cancel(adas[0])
    stopped = lambda held: lifecycle.stop(held, token=tokens[0], now=world.now, retention=0)  # noqa: E731
    world.pass_seconds(10, meanwhile=alive)
    assert waiting() == bobs, "a job being cancelled still runs"
    world.jobs.records.update(adas[0], stopped)
    world.pass_seconds(1, meanwhile=alive)
    assert waiting() == [*bobs, adas[2]], "at the next look, the oldest first"
    world.pass_seconds(10, meanwhile=alive)
    assert waiting() == [*bobs, adas[2]]
    world.jobs.cancel(adas[3])
    world.jobs.cancel(adas[2])
    world.pass_seconds(1, meanwhile=alive)
    assert waiting() == [*bobs, adas[4]]
    assert "forgotten" not in world.jobs.log(adas[4])


def test_a_job_held_back_and_let_go_between_two_looks_is_not_taken_for_forgotten(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=1)

    def made() -> str:
        world.now += timedelta(milliseconds=10)
        return world.jobs.submit(inputs_file, options=Options(), interpretation=interpretation).id

    running = made()
    token = world.claim(running)
    world.pass_seconds(1)
    held = made()
    world.jobs.cancel(running)
    world.jobs.records.update(
        running, lambda stored: lifecycle.stop(stored, token=token, now=world.now, retention=60.0)
    )
    world.pass_seconds(1)
    assert [each.rpartition("-")[0] for each in world.jobs.queue.waiting()] == [held], "at the very next look"
    assert world.jobs.log(held) == ""
    assert world.jobs.queue.held() == set()


def test_what_is_held_back_is_known_to_a_keeper_that_has_only_begun(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=1)
    first, second = (
        world.jobs.submit(inputs_file, options=Options(), interpretation=interpretation, id=f"job-{n}").id for n in "12"
    )
    world.jobs.queue.let_go(world.jobs.records.get(second).token)  # as if nobody had had the time to note it
    world.pass_seconds(1)
    assert world.jobs.queue.held() == {world.jobs.records.get(second).token}
    world.keeper = Keeper(jobs=world.jobs, clock=lambda: world.monotonic)
    world.jobs.cancel(first)
    world.jobs.queue.hold("gone-0")
    world.pass_seconds(1)
    assert [each.rpartition("-")[0] for each in world.jobs.queue.waiting()] == [second]
    assert "forgotten" not in world.jobs.log(second)
    assert world.jobs.queue.held() == set(), "nor is a note kept of a job that is gone"


def test_a_job_on_its_way_to_a_worker_counts_as_running(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=1)
    first, second = (
        world.jobs.submit(inputs_file, options=Options(), interpretation=interpretation, id=f"job-{n}").id for n in "12"
    )
    world.pass_seconds(1)
    token = world.jobs.records.get(first).token
    world.jobs.queue.remove(token)  # taken by a worker that has not claimed it yet
    world.pass_seconds(2)
    assert world.jobs.queue.waiting() == []
    world.pass_seconds(2)
    assert [each.rpartition("-")[0] for each in world.jobs.queue.waiting()] == [first], "lost on its way: queued again"
    assert world.jobs.get(second).status is Status.QUEUED


@pytest.mark.parametrize("jump", [timedelta(days=365), timedelta(days=-365)])
def test_a_jump_of_the_clock_loses_nothing(
    world: World, jump: timedelta, inputs_file: Path, interpretation: Interpretation
) -> None:
    def submit() -> str:
        return world.jobs.submit(inputs_file, options=Options(), interpretation=interpretation).id

    done, busy, waiting = submit(), submit(), submit()
    world.claim(done)
    world.jobs.cancel(done)
    token = world.jobs.records.get(done).token
    world.jobs.records.update(done, lambda held: lifecycle.stop(held, token=token, now=world.now, retention=60.0))
    token = world.claim(busy)
    world.pass_seconds(2, meanwhile=lambda: world.jobs.records.beat(busy, token))
    world.now += jump
    world.pass_seconds(70, meanwhile=lambda: world.jobs.records.beat(busy, token))
    assert world.jobs.get(done).status is Status.CANCELLED, "held, although by the new clock its time may be over"
    assert (world.jobs.get(busy).status, world.jobs.get(busy).attempt) == (Status.RUNNING, 1)
    assert world.jobs.get(waiting).place_in_queue == 0
    assert findings(world.jobs, settle=0) == []
    world.now -= jump  # put right
    world.pass_seconds(3700, meanwhile=lambda: world.jobs.records.beat(busy, token))
    with pytest.raises(UnknownJob):
        world.jobs.get(done)
    assert world.jobs.get(busy).attempt == 1


def test_a_tokens_own_bound_on_running_jobs_goes_before_the_usual_one(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=2)

    def made(owner: str, most: int | None) -> str:
        jobs = dataclasses.replace(world.jobs.of(owner), max_running=most)
        world.now += timedelta(milliseconds=10)
        return jobs.submit(inputs_file, options=Options(), interpretation=interpretation).id

    ones, threes, usual, free = ([made(f"{most}", most) for _ in range(4)] for most in (1, 3, None, 0))
    expected = [*ones[:1], *threes[:3], *usual[:2], *free]
    for _ in range(2):
        assert [token.rpartition("-")[0] for token in world.jobs.queue.waiting()] == expected
        assert findings(world.jobs, settle=0) == []
        world.pass_seconds(10)

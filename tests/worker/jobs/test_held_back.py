"""Jobs above their owner's limit of running jobs: held back, and started when capacity is free."""

from __future__ import annotations

import dataclasses
from datetime import timedelta
from pathlib import Path

from pliant.schemas.job import Interpretation, Status
from pliant.schemas.options import Options
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.submission import Submission
from pliant.worker.maintenance.fsck import findings
from pliant.worker.maintenance.reconciler import Reconciler
from reconciler_world import World


def test_the_running_limit_holds_and_the_next_job_starts_when_one_ends(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=2)

    def made(owner: str) -> str:
        jobs = world.jobs.of(owner)
        world.now += timedelta(milliseconds=10)
        return jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id

    def waiting() -> list[str]:
        return [attempt_id.rpartition("-")[0] for attempt_id in world.jobs.queue.waiting()]

    adas = [made("ada") for _ in range(5)]
    bobs = [made("bob")]
    assert waiting() == [*adas[:2], *bobs]
    world.pass_seconds(30)
    assert waiting() == [*adas[:2], *bobs], "what is held back is not taken for forgotten"
    assert findings(world.jobs, pause=0) == []
    unset = dataclasses.replace(world.jobs, settings=dataclasses.replace(world.jobs.settings, max_running=0))
    assert findings(unset, pause=0) == [], "nor by an operator whose shell has no PLIANT_MAX_RUNNING"
    attempt_ids = [world.claim(adas[0]), world.claim(adas[1])]

    def alive() -> None:
        for id, attempt_id in zip(adas, attempt_ids, strict=False):
            world.jobs.records.beat(id, attempt_id)

    world.pass_seconds(10, meanwhile=alive)
    assert waiting() == bobs
    world.jobs.cancel(adas[0])
    stopped = lambda held: lifecycle.stop(held, attempt_id=attempt_ids[0], now=world.now, retention=0)  # noqa: E731
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


def test_a_job_released_between_two_checks_is_not_considered_lost(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=1)

    def made() -> str:
        world.now += timedelta(milliseconds=10)
        return world.jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id

    running = made()
    attempt_id = world.claim(running)
    world.pass_seconds(1)
    held = made()
    world.jobs.cancel(running)
    world.jobs.records.update(
        running, lambda stored: lifecycle.stop(stored, attempt_id=attempt_id, now=world.now, retention=60.0)
    )
    world.pass_seconds(1)
    assert [each.rpartition("-")[0] for each in world.jobs.queue.waiting()] == [held], "at the very next look"
    assert world.jobs.log(held) == ""
    assert world.jobs.queue.held() == set()


def test_a_new_reconciler_knows_the_held_back_jobs(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=1)
    first, second = (
        world.jobs.submit(inputs_file, Submission(options=Options(), id=f"job-{n}"), interpretation=interpretation)[
            0
        ].id
        for n in "12"
    )
    world.jobs.queue.release(world.jobs.records.get(second).attempt_id)  # as if there had been no time to note it
    world.pass_seconds(1)
    assert world.jobs.queue.held() == {world.jobs.records.get(second).attempt_id}
    world.reconciler = Reconciler(jobs=world.jobs, clock=lambda: world.monotonic)
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
        world.jobs.submit(inputs_file, Submission(options=Options(), id=f"job-{n}"), interpretation=interpretation)[
            0
        ].id
        for n in "12"
    )
    world.pass_seconds(1)
    attempt_id = world.jobs.records.get(first).attempt_id
    world.jobs.queue.remove(attempt_id)  # taken by a worker that has not claimed it yet
    world.pass_seconds(2)
    assert world.jobs.queue.waiting() == []
    world.pass_seconds(2)
    assert [each.rpartition("-")[0] for each in world.jobs.queue.waiting()] == [first], "lost on its way: queued again"
    assert world.jobs.get(second).status is Status.QUEUED


def test_a_tokens_running_limit_overrides_the_default(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=2)

    def made(owner: str, most: int | None) -> str:
        jobs = dataclasses.replace(world.jobs.of(owner), max_running=most)
        world.now += timedelta(milliseconds=10)
        return jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id

    ones, threes, usual, free = ([made(f"{most}", most) for _ in range(4)] for most in (1, 3, None, 0))
    expected = [*ones[:1], *threes[:3], *usual[:2], *free]
    for _ in range(2):
        assert [attempt_id.rpartition("-")[0] for attempt_id in world.jobs.queue.waiting()] == expected
        assert findings(world.jobs, pause=0) == []
        world.pass_seconds(10)


def test_the_place_in_queue_is_zero_once_a_worker_has_taken_the_job_and_null_while_it_is_held_back(
    tmp_path: Path, inputs_file: Path, interpretation: Interpretation
) -> None:
    world = World(tmp_path, max_running=1)
    jobs = world.jobs.of("ada")
    first, second = (
        jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0] for _ in range(2)
    )
    assert (first.place_in_queue, second.place_in_queue) == (0, None)
    world.jobs.queue.remove(world.jobs.queue.waiting()[0])
    places = {job.id: job.place_in_queue for job in jobs.page().jobs}
    assert places == {first.id: 0, second.id: None}
    assert (jobs.get(first.id).place_in_queue, jobs.get(second.id).place_in_queue) == (0, None)

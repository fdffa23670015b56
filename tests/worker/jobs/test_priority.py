"""Priorities order the waiting jobs of one owner; nobody else's job moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pliant.worker.jobs.retry import retry
from pliant.worker.jobs.service import Jobs
from reconciler_world import World


def names(jobs: Jobs) -> list[str]:
    ids = [attempt.rpartition("-")[0] for attempt in jobs.queue.waiting()]
    return [jobs.get(id).name for id in ids]


def test_priority_overtakes_only_jobs_of_the_same_owner(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ada, bob = jobs.of("ada"), jobs.of("bob")
    submit(ada, name="a1")
    submit(bob, name="b1")
    submit(ada, name="a2-low", priority="low")
    submit(bob, name="b2")
    submit(ada, name="a3")
    submit(ada, name="a4-high", priority="high")
    assert names(jobs) == ["a4-high", "b1", "a1", "b2", "a3", "a2-low"]
    submit(ada, name="a5-high", priority="high")
    assert names(jobs) == ["a4-high", "b1", "a5-high", "b2", "a1", "a3", "a2-low"]
    listed = {each.name: each.priority for each in (jobs.get(found.id) for found in jobs.page(limit=10).jobs)}
    assert (listed["a1"], listed["a2-low"], listed["a4-high"], listed["a5-high"]) == ("normal", "low", "high", "high")


def test_a_retried_job_keeps_its_priority(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    first = submit(name="first", priority="high")
    jobs.cancel(first.id)
    assert retry(jobs, first.id).priority == "high"


def test_ordering_unknown_jobs_changes_nothing(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    submit(name="only")
    before = jobs.queue.waiting()
    jobs.queue.order({"somebody-else": 0})
    jobs.queue.order({})
    assert jobs.queue.waiting() == before


def test_a_high_priority_does_not_lift_the_running_limit(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ada = replace(jobs.of("ada"), max_running=1)
    submit(ada, name="a1")
    submit(ada, name="a2-high", priority="high")
    assert names(jobs) == ["a1"], "fairness between owners stays: one of hers at once"


def test_jobs_of_a_lost_worker_are_requeued_in_order_of_priority(tmp_path: Path, submit) -> None:  # type: ignore[no-untyped-def]
    world = World(tmp_path)
    lost = {name: submit(world.jobs, name=name, priority=name).id for name in ("low", "normal", "high")}  # type: ignore[arg-type]
    attempts = [world.claim(id) for id in lost.values()]
    others = [submit(world.jobs, name=f"waiting-{name}", priority=name).id for name in ("high", "normal", "low")]
    assert names(world.jobs) == ["waiting-high", "waiting-normal", "waiting-low"]
    world.pass_seconds(7)
    assert [world.jobs.get(id).attempt for id in lost.values()] == [1, 1, 1]
    assert not set(attempts) & set(world.jobs.queue.waiting())
    order = names(world.jobs)
    ranks = {"high": 0, "normal": 1, "low": 2}
    assert [ranks[name.rpartition("-")[2]] for name in order] == [0, 0, 1, 1, 2, 2]
    assert order[0] == "high", "it has been at the front before"
    assert len(others) == 3


def test_a_lost_delivery_is_queued_by_its_priority(tmp_path: Path, submit) -> None:  # type: ignore[no-untyped-def]
    world = World(tmp_path)
    forgotten = submit(world.jobs, name="low", priority="low")
    submit(world.jobs, name="normal")
    world.jobs.queue.remove(world.jobs.records.get(forgotten.id).attempt_id)
    world.pass_seconds(5)
    assert names(world.jobs) == ["normal", "low"]


def test_the_held_back_job_of_highest_priority_starts_first(tmp_path: Path, submit) -> None:  # type: ignore[no-untyped-def]
    world = World(tmp_path, max_running=1)
    first = submit(world.jobs, name="first")
    submit(world.jobs, name="second")
    submit(world.jobs, name="urgent", priority="high")
    assert names(world.jobs) == ["first"]
    world.pass_seconds(2)
    world.jobs.cancel(first.id)
    world.pass_seconds(2)
    assert names(world.jobs) == ["urgent"]


def test_the_stores_keep_the_priority_of_an_attempt(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    id = submit(priority="high").id
    assert jobs.records.beats([id])[id].priority == "high"

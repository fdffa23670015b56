"""Priorities order the waiting jobs of one owner; nobody else's job moves."""

from __future__ import annotations

from dataclasses import replace

from pliant.worker.jobs.service import Jobs


def names(jobs: Jobs) -> list[str]:
    ids = [attempt.rpartition("-")[0] for attempt in jobs.queue.waiting()]
    return [jobs.get(id).name for id in ids]


def test_a_job_passes_only_its_owners_jobs(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
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
    assert jobs.get(jobs.page(limit=1).jobs[0].id).priority == "high"


def test_a_job_run_again_keeps_its_priority(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    first = submit(name="first", priority="high")
    jobs.cancel(first.id)
    assert jobs.retry(first.id).priority == "high"


def test_ordering_what_is_not_there_changes_nothing(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    submit(name="only")
    before = jobs.queue.waiting()
    jobs.queue.order({"somebody-else": 0})
    jobs.queue.order({})
    assert jobs.queue.waiting() == before


def test_held_back_jobs_are_not_queued_by_their_priority(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ada = replace(jobs.of("ada"), max_running=1)
    submit(ada, name="a1")
    submit(ada, name="a2-high", priority="high")
    assert names(jobs) == ["a1"], "fairness between owners stays: one of hers at once"

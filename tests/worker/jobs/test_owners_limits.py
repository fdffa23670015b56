"""Limits of queued and running jobs per owner, on Redis and on in-memory stores."""

from __future__ import annotations

import dataclasses
import threading
from datetime import UTC, datetime

import pytest
from pliant.schemas.job import Status
from pliant.worker.errors import (
    TooManyQueued,
)
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs


def test_the_limit_of_queued_jobs_is_enforced_per_owner(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ada, bob = (dataclasses.replace(jobs.of(owner), max_queued=2) for owner in ("ada", "bob"))
    first, _ = submit(ada), submit(ada, id="second", fingerprint="f")
    before = list(jobs.blobs.list("jobs/"))
    ada.check_capacity(id="second")
    for refused in (
        lambda: submit(ada),
        lambda: ada.check_capacity(id="third"),
        lambda: ada.check_capacity(idempotency_key="k"),
    ):
        with pytest.raises(TooManyQueued, match="2 jobs are already queued"):
            refused()
    assert list(jobs.blobs.list("jobs/")) == before, "what was refused leaves no file"
    assert submit(ada, id="second", fingerprint="f").id == "second"
    submit(bob)
    submit(jobs)
    attempt_id = jobs.records.get(first.id).attempt_id
    jobs.records.update(
        first.id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="w", now=datetime.now(UTC))
    )
    submit(ada)
    with pytest.raises(TooManyQueued):
        submit(ada)


def test_simultaneous_submissions_respect_the_limit(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ada = dataclasses.replace(jobs.of("ada"), max_queued=3)
    refused: list[Exception] = []

    def one() -> None:
        try:
            submit(ada)
        except TooManyQueued as error:
            refused.append(error)

    threads = [threading.Thread(target=one) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (ada.count([Status.QUEUED]), len(refused)) == (3, 9)


def test_a_repeated_key_returns_its_job_even_if_the_queue_is_full(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ada = dataclasses.replace(jobs.of("ada"), max_queued=1)
    job = submit(ada, idempotency_key="k", fingerprint="f")
    ada.check_capacity(idempotency_key="k")
    assert submit(ada, idempotency_key="k", fingerprint="f").id == job.id


def test_a_job_over_the_running_limit_is_held_back_until_it_is_cancelled(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ada = dataclasses.replace(jobs.of("ada"), max_running=1)
    first, second = submit(ada), submit(ada)
    assert jobs.queue.waiting() == [jobs.records.get(first.id).attempt_id]
    assert jobs.queue.held() == {jobs.records.get(second.id).attempt_id}
    ada.cancel(second.id)
    assert jobs.queue.held() == set()


def test_the_tokens_running_limit_is_stored_with_each_job(jobs: Jobs, submit) -> None:  # type: ignore[no-untyped-def]
    ids = [submit(dataclasses.replace(jobs.of("ada"), max_running=most)).id for most in (None, 0, 3)]
    beats = jobs.records.beats(ids)
    assert [(beats[id].owner, beats[id].max_running) for id in ids] == [("ada", None), ("ada", 0), ("ada", 3)]
    assert [jobs.records.get(id).max_running for id in ids] == [None, 0, 3]

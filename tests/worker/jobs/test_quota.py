"""The disk quota counts the results of unfinished jobs by their expected size, those of finished ones by their size."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from datetime import UTC, datetime

import pytest
from pliant.schemas.job import Artifact, Interpretation, Job, Problem
from pliant.schemas.options import Options
from pliant.worker.errors import QuotaExceeded
from pliant.worker.formats.cost import expected_files
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.finished import Finished
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission

NOW = datetime(2026, 5, 4, 9, 30, tzinfo=UTC)

INPUTS = 3_000_000
"""Bytes of the inputs that `submit` sends."""

Submit = Callable[..., Job]


@pytest.fixture
def interpretation(interpretation: Interpretation) -> Interpretation:
    return interpretation.model_copy(update={"num_frames": 100, "num_points": 500})


@pytest.fixture
def results(interpretation: Interpretation) -> int:
    return expected_files(interpretation, Options())


def limited(jobs: Jobs, quota: int) -> Jobs:
    return dataclasses.replace(jobs, settings=dataclasses.replace(jobs.settings, disk_quota=quota))


def test_a_job_is_refused_if_the_results_of_waiting_jobs_will_fill_the_quota(
    jobs: Jobs, submit: Submit, results: int
) -> None:
    assert results > INPUTS
    tight = limited(jobs, 2 * (INPUTS + results) - 1)
    submit(tight)
    with pytest.raises(QuotaExceeded) as caught:
        submit(tight)
    assert f"{INPUTS + results:,} more are needed (about {results:,} for the results)" in str(caught.value)
    assert caught.value.retryable
    submit(limited(jobs, 2 * (INPUTS + results)))
    with pytest.raises(QuotaExceeded, match=r"Disk quota too small: .* bytes are needed \(about"):
        submit(limited(jobs, INPUTS + results - 1))


@pytest.mark.parametrize("end", ["succeeded", "failed", "cancelled", "stopped"])
def test_an_ended_job_counts_with_what_it_keeps(jobs: Jobs, submit: Submit, results: int, end: str) -> None:
    tight = limited(jobs, 10 * INPUTS)
    job = submit(tight)
    assert tight.used() == INPUTS + results
    attempt_id = jobs.records.get(job.id).attempt_id
    about = {"attempt_id": attempt_id, "now": NOW, "retention": 0.0}
    if end == "cancelled":
        tight.cancel(job.id)
    else:
        jobs.records.update(job.id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="w", now=NOW))
        assert tight.used() == INPUTS + results
    if end == "succeeded":
        artifact = Artifact(name="shapes.npz", media_type="application/zip", bytes=77, sha256="0" * 64)
        finished = Finished(metrics={}, outcome="converged", sentence="", warnings=(), artifacts=(artifact,))
        jobs.records.update(job.id, lambda held: lifecycle.succeed(held, finished, prefix="p/", **about))
    elif end == "failed":
        problem = Problem.of("internal_error", detail="It failed.")
        jobs.records.update(job.id, lambda held: lifecycle.fail(held, problem=problem, **about))
    elif end == "stopped":
        tight.cancel(job.id)
        jobs.records.update(job.id, lambda held: lifecycle.stop(held, **about))
    assert tight.used() == INPUTS + (77 if end == "succeeded" else 0)
    assert jobs.records.get(job.id).reserved == 0
    tight.delete(job.id)
    assert tight.used() == 0


def test_without_a_quota_nothing_is_reserved(jobs: Jobs, submit: Submit) -> None:
    submit()
    assert jobs.used() == INPUTS


def test_a_retry_reserves_too(jobs: Jobs, submit: Submit, results: int) -> None:
    tight = limited(jobs, 10 * INPUTS)
    stored = jobs.records.get(submit(tight).id)
    tight.cancel(stored.job.id)
    again = lifecycle.again(stored.job, id="again-1", now=NOW)
    tight.create_copy(again, Submission(options=Options()), stored, inputs=stored.inputs, result=None)
    assert tight.used() == 2 * INPUTS + results

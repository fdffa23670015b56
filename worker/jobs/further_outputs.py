"""Further files of a finished job: a new job writes them from the stored result, without solving again."""

from __future__ import annotations

import hashlib
from dataclasses import replace

from pliant.schemas.job import Job, Status
from pliant.schemas.options import Options
from pliant.schemas.outputs import OutputRequest
from pliant.worker.artifacts import kinds_for
from pliant.worker.errors import NotAllowedNow
from pliant.worker.ids import new_job_id
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.records import Stored

RESULT = "shapes.npz"
TRACKS = "tracks.npz"
"""File of a film job with the tracks that were solved."""


def make_outputs(
    jobs: Jobs, id: str, request: OutputRequest, *, idempotency_key: str | None = None
) -> tuple[Job, bool]:
    """Queue a job that writes further files of a result; return the job, and whether it is new.

    The new job has its own copies of inputs and result, so the original may be deleted meanwhile. It counts against the usual
    limits. A repeated request returns the same job, except that a request without a key creates another job if the earlier one
    failed or was cancelled.

    Raises
    ------
    Conflict
        The key belongs to a different request.
    InvalidInput
        A file cannot be written in this installation, or not at this size.
    InvalidRequest
        The key is malformed.
    NotAllowedNow
        The job has no result, or only writes further files itself.
    QuotaExceeded, TooManyQueued
        See `Jobs.submit`.
    UnknownJob
        There is no such job, or it was deleted meanwhile.
    """
    wish = hashlib.sha256(f"outputs of {id}: {request.model_dump_json()}".encode()).hexdigest()
    if idempotency_key is not None:  # a repeated request returns its job, even if the original has been deleted
        known = jobs.known(Submission(options=Options(), idempotency_key=idempotency_key, fingerprint=wish))
        if known is not None:
            return known, False
    stored = jobs.stored(id)
    job = stored.job
    implicit = f"outputs {wish} of {stored.attempt_id}"  # a job of the same id may have been deleted
    submission = Submission(
        options=request.applied_to(job.options), name=job.name, idempotency_key=idempotency_key or implicit,
        fingerprint=wish,
    )  # fmt: skip
    while (known := jobs.known(submission)) is not None:
        if idempotency_key is not None or known.status not in (Status.FAILED, Status.CANCELLED):
            return known, False
        submission = replace(submission, idempotency_key=f"{implicit} after {known.id}")
    _check(stored, submission)
    further = lifecycle.again(job, id=new_job_id(), now=jobs.clock(), outputs_of=id, options=submission.options)
    made = jobs.create_copy(further, submission, stored, inputs=_inputs_of(stored), result=f"{stored.prefix}{RESULT}")
    return made, made.id == further.id


def _check(stored: Stored, submission: Submission) -> None:
    """Check that the job has a result from which the files can be written."""
    job = stored.job
    if job.outputs_of is not None:
        hint = f"It holds further files of job {job.outputs_of!r}: make them from that one."
        raise NotAllowedNow(job.id, job.status, wanted="exported to further files", hint=hint)
    if job.status is not Status.SUCCEEDED:
        hint = "It has no result." if job.status.final else "Wait until it has succeeded."
        raise NotAllowedNow(job.id, job.status, wanted="exported to further files", hint=hint)
    read = job.interpretation
    kinds_for(submission.options, size=(read.num_frames, read.num_points))


def _inputs_of(stored: Stored) -> str:
    """Return the blob of the solved tracks: for a film job, `tracks.npz` instead of the film."""
    own = (f"{stored.prefix}{each.name}" for each in stored.job.artifacts if each.name == TRACKS)
    return next(own, stored.inputs)

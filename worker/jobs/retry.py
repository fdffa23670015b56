"""Retry of a failed or cancelled job at its owner's request.

The automatic repeat of a job whose worker was lost is `lifecycle.requeue`, which `maintenance.reconciler` applies.
"""

from __future__ import annotations

import hashlib

from pliant.schemas.job import Job, Status
from pliant.schemas.options import Options
from pliant.worker.errors import NotAllowedNow
from pliant.worker.ids import new_job_id
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission


def retry(jobs: Jobs, id: str, *, idempotency_key: str | None = None) -> Job:
    """Run a failed or cancelled job again, as a new job with the same inputs, options, name and webhook.

    A repeated request with the same key returns the first new job.

    Raises
    ------
    Conflict
        The key belongs to a different request.
    InvalidRequest
        The key is malformed.
    NotAllowedNow
        The job is not finished, or has succeeded.
    UnknownJob
        There is no such job, or it was deleted in the meantime.
    """
    # Before the job is read: a repeated request returns the new job, even if this one has been deleted.
    fingerprint = hashlib.sha256(f"retry of {id}".encode()).hexdigest()
    known = jobs.known(Submission(options=Options(), idempotency_key=idempotency_key, fingerprint=fingerprint))
    if known is not None:
        return known
    stored = jobs.stored(id)
    job = stored.job
    submission = Submission(
        options=job.options, name=job.name, idempotency_key=idempotency_key, webhook=stored.webhook, fingerprint=fingerprint,
    )  # fmt: skip
    if job.status not in (Status.FAILED, Status.CANCELLED):
        hint = (
            "It already has a result." if job.status is Status.SUCCEEDED else "Wait until it ends, or cancel it first."
        )
        raise NotAllowedNow(id, job.status, wanted="run again", hint=hint)
    again = lifecycle.again(job, id=new_job_id(), now=jobs.clock(), retry_of=id)
    return jobs.create_copy(again, submission, stored, inputs=stored.inputs, result=stored.result)

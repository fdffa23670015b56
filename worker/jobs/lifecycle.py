"""The state machine of a job: pure functions from record to record, the only code that changes a status.

::

    queued ──claim──▶ running ──succeed──▶ succeeded
      │ ▲               │ │ └──fail──────▶ failed
      │ └───requeue─────┘ └─cancel─▶ cancelling ──stop──▶ cancelled
      └──cancel──▶ cancelled

A final status never changes: running a finished job again is a new job (`again`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta

from pliant.schemas.job import Job, Problem, Progress, Status
from pliant.worker.errors import NotAllowedNow, StaleAttempt
from pliant.worker.jobs.finished import Finished
from pliant.worker.records import Stored

ACTIVE = (Status.RUNNING, Status.CANCELLING)
FINAL = tuple(status for status in Status if status.final)


def again(job: Job, *, id: str, now: datetime, **changes: object) -> Job:
    """Return a new queued job with the fields of a finished one, updated by `changes`.

    Metrics, outcome, verdict and warnings are kept: a failed or cancelled job has them only if it works from a stored result,
    which they describe; a failed one may have warnings about its film.
    """
    fresh: dict[str, object] = {
        "id": id, "status": Status.QUEUED, "created_at": now, "started_at": None, "finished_at": None, "expires_at": None,
        "attempt": 0, "retry_of": None, "progress": None, "artifacts": [], "error": None,
    }  # fmt: skip
    return job.model_copy(update=fresh | changes)


def claim(stored: Stored, *, attempt_id: str, worker: str, now: datetime) -> Stored:
    """Start the job. Repeating a claim whose reply was lost changes nothing.

    Raises
    ------
    StaleAttempt
        The job is not queued under this attempt id: a duplicate or late delivery.
    """
    mine = stored.attempt_id == attempt_id and stored.worker == worker and stored.job.started_at == now
    if mine and stored.job.status in ACTIVE:
        return stored
    if stored.attempt_id != attempt_id or stored.job.status is not Status.QUEUED:
        raise StaleAttempt(stored.job.id)
    begun = {"status": Status.RUNNING, "started_at": now, "attempt": stored.job.attempt + 1, "progress": None}
    return _changed(stored, begun, worker=worker)


def report(stored: Stored, *, attempt_id: str, progress: Progress) -> Stored:
    """Record the progress of the job.

    Raises
    ------
    StaleAttempt
        The job belongs to another attempt, or is finished.
    """
    _check_owner(stored, attempt_id)
    return _changed(stored, {"progress": progress})


def succeed(
    stored: Stored, finished: Finished, *, attempt_id: str, prefix: str, now: datetime, retention: float
) -> Stored:
    """Publish the result, and interpretation and options if the job determined them.

    A job whose cancellation was requested in the meantime ends cancelled.

    Raises
    ------
    StaleAttempt
        The job belongs to another attempt, or is finished.
    """
    _check_owner(stored, attempt_id)
    if stored.job.status is Status.CANCELLING:
        return stop(stored, attempt_id=attempt_id, now=now, retention=retention)
    last = stored.job.progress
    update = {
        "progress": None if last is None else last.model_copy(update={"fraction": 1.0, "seconds_left": 0.0}),
        "metrics": finished.metrics,
        "outcome": finished.outcome,
        "sentence": finished.sentence,
        "verdict": finished.verdict,
        "verdict_reasons": list(finished.verdict_reasons),
        "trust_sentence": finished.trust_sentence,
        "warnings": list(finished.warnings),
        "artifacts": list(finished.artifacts),
        **({} if finished.interpretation is None else {"interpretation": finished.interpretation}),
        **({} if finished.options is None else {"options": finished.options}),
    }
    size = stored.bytes + sum(each.bytes for each in finished.artifacts)
    published = _changed(stored, update, prefix=prefix, bytes=size)
    return _finish(published, Status.SUCCEEDED, now=now, retention=retention)


def fail(
    stored: Stored,
    *,
    attempt_id: str,
    problem: Problem,
    now: datetime,
    retention: float,
    warnings: Sequence[str] = (),
) -> Stored:
    """Record why the attempt failed, and its warnings until then; a job that was being cancelled ends cancelled.

    Raises
    ------
    StaleAttempt
        The job belongs to another attempt, or is finished.
    """
    _check_owner(stored, attempt_id)
    if stored.job.status is Status.CANCELLING:
        return stop(stored, attempt_id=attempt_id, now=now, retention=retention)
    update = {"error": problem, "warnings": list(warnings) or stored.job.warnings}
    return _finish(_changed(stored, update), Status.FAILED, now=now, retention=retention)


def stop(stored: Stored, *, attempt_id: str, now: datetime, retention: float) -> Stored:
    """End the attempt after a cancellation.

    Raises
    ------
    StaleAttempt
        The job belongs to another attempt, is finished, or was not cancelled.
    """
    _check_owner(stored, attempt_id)
    if stored.job.status is not Status.CANCELLING:
        raise StaleAttempt(stored.job.id)
    return _finish(stored, Status.CANCELLED, now=now, retention=retention)


def cancel(stored: Stored, *, now: datetime, retention: float) -> Stored:
    """Cancel the job: a queued one ends at once, a running one is marked as cancelling. Idempotent.

    Raises
    ------
    NotAllowedNow
        The job has succeeded or failed.
    """
    status = stored.job.status
    if status is Status.QUEUED:
        return _finish(stored, Status.CANCELLED, now=now, retention=retention)
    if status is Status.RUNNING:
        return _changed(stored, {"status": Status.CANCELLING})
    if status in (Status.CANCELLING, Status.CANCELLED):
        return stored
    raise NotAllowedNow(
        stored.job.id, status, wanted="cancelled", hint="It is finished; delete it if you do not need it."
    )


def requeue(
    stored: Stored,
    *,
    attempt_id: str,
    fresh: str,
    problem: Problem,
    now: datetime,
    max_attempts: int | None,
    retention: float,
) -> Stored:
    """Requeue a job that lost its worker, as attempt `fresh`; after `max_attempts` it fails with `problem`.

    `max_attempts` is None for a stop of the installation, which does not count.

    Raises
    ------
    StaleAttempt
        The job belongs to another attempt, or is finished.
    """
    _check_owner(stored, attempt_id)
    spent = max_attempts is not None and stored.job.attempt - stored.stops >= max_attempts
    if spent or stored.job.status is Status.CANCELLING:
        return fail(stored, attempt_id=attempt_id, problem=problem, now=now, retention=retention)
    waiting = {"status": Status.QUEUED, "started_at": None, "progress": None}
    stops = stored.stops + (max_attempts is None)
    return _changed(stored, waiting, attempt_id=fresh, worker=None, stops=stops)


def redeliver(stored: Stored, *, attempt_id: str, fresh: str) -> Stored:
    """Give a queued job whose delivery was lost a new attempt id, so that only the new delivery is valid.

    Raises
    ------
    StaleAttempt
        The job is no longer queued under that attempt_id.
    """
    if stored.attempt_id != attempt_id or stored.job.status is not Status.QUEUED:
        raise StaleAttempt(stored.job.id)
    return stored.model_copy(update={"attempt_id": fresh})


def _check_owner(stored: Stored, attempt_id: str) -> None:
    if stored.attempt_id != attempt_id or stored.job.status not in ACTIVE:
        raise StaleAttempt(stored.job.id)


def _finish(stored: Stored, status: Status, *, now: datetime, retention: float) -> Stored:
    expires = now + timedelta(seconds=retention) if retention > 0 else None
    ended = {"status": status, "finished_at": now, "expires_at": expires}
    return _changed(stored, ended, bytes=stored.bytes - stored.reserved, reserved=0)


def _changed(stored: Stored, of_job: Mapping[str, object], **of_record: object) -> Stored:
    return stored.model_copy(update={"job": stored.job.model_copy(update=of_job), **of_record})

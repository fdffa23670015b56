"""The submission record, and the creation of a job: quota, inputs, record and queue entry, in this order."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pliant.schemas.job import Priority, Status
from pliant.schemas.options import Options
from pliant.worker.errors import QuotaExceeded, StoreUnavailable, TooManyQueued
from pliant.worker.records import Records, Stored, Webhook
from pliant.worker.store.queue import Queue
from pliant.worker.uploads.shared import open_uploads

if TYPE_CHECKING:
    from pliant.worker.jobs.service import Jobs

RANKS: dict[Priority, int] = {"high": 0, "normal": 1, "low": 2}
"""Queue rank of each priority; smaller ranks run first."""


def order_waiting(records: Records, queue: Queue, owners: Collection[str]) -> None:
    """Sort each owner's waiting jobs by priority within their own queue positions, so that no other owner's job moves."""
    waiting = set(queue.waiting())
    beats = [each for each in records.beats(records.ids(Status.QUEUED)).values() if each.attempt_id in waiting]
    for owner in owners:
        queue.order({each.attempt_id: RANKS[each.priority] for each in beats if each.owner == owner})


def push_or_hold(jobs: Jobs, stored: Stored) -> bool:
    """Queue a stored job, or hold it back until its owner has fewer running jobs; return whether it was queued.

    The reconciler queues jobs that are held back. Jobs are counted after the record is written, so that simultaneous submissions
    count each other.
    """
    most = jobs.settings.max_running if stored.max_running is None else stored.max_running
    unfinished = (Status.QUEUED, Status.RUNNING, Status.CANCELLING)
    if 0 < most < jobs.records.count(unfinished, owner=stored.owner):
        jobs.queue.hold(stored.attempt_id)
        return False
    jobs.queue.push(stored.job.id, stored.attempt_id)
    return True


@dataclass(frozen=True, slots=True, kw_only=True)
class Submission:
    """A client's request, without the input files."""

    options: Options
    """How to solve and which files to write."""

    name: str = ""
    """The user's label."""

    id: str | None = None
    """Id chosen by the client: 3–64 letters, digits, underscores, dashes; None: generated."""

    idempotency_key: str | None = None
    """A repeated request with the same key returns the existing job; a key is kept as long as its job."""

    fingerprint: str | None = None
    """SHA-256 of the complete request, which distinguishes a repeated request from a different one."""

    webhook: Webhook | None = None
    """Called when the job has ended."""

    priority: Priority = "normal"
    """Order among the waiting jobs of the owner."""


def accept(jobs: Jobs, stored: Stored, put: Callable[[str], object]) -> Stored:
    """Store inputs, record and queue entry, in this order; a failure in between leaves no accepted job.

    `put` stores the inputs under a blob key. Returns the new record, or the one that already has its idempotency key or id.

    Raises
    ------
    TooManyQueued
        The owner's limit on queued jobs is reached; nothing is stored.
    QuotaExceeded
        The job does not fit into the disk quota beside jobs, uploads and reservations; nothing is stored.
    """
    quota = jobs.settings.disk_quota
    if quota > 0 and (used := jobs.records.used() + _uploaded(jobs)) + stored.bytes > quota:
        raise QuotaExceeded(used=used, quota=quota, needed=stored.bytes, results=stored.reserved)
    put(stored.inputs)
    most = max(1, quota - _uploaded(jobs)) if quota > 0 else 0
    try:
        kept = jobs.records.create(stored, max_queued=jobs.max_queued, max_bytes=most)
    except (TooManyQueued, QuotaExceeded):
        jobs.blobs.delete(folder_of(stored.inputs))
        raise
    if kept.inputs != stored.inputs:
        jobs.blobs.delete(folder_of(stored.inputs))
        return kept
    try:
        if push_or_hold(jobs, stored) and stored.job.priority != "normal":
            order_waiting(jobs.records, jobs.queue, [stored.owner])
    except StoreUnavailable:
        return kept  # the record is stored, and the reconciler adds the missing queue entry
    return kept


def _uploaded(jobs: Jobs) -> int:
    return open_uploads(jobs.settings, jobs.blobs).used()


def folder_of(inputs: str) -> str:
    """Return the blob prefix of an attempt, from the key of its inputs."""
    return inputs.rpartition("/")[0] + "/"


def key_digest(idempotency_key: str | None, owner: str | None) -> str | None:
    """Return the digest under which an owner's idempotency key is stored."""
    if idempotency_key is None:
        return None
    return hashlib.sha256(f"{owner or ''}\n{idempotency_key}".encode()).hexdigest()

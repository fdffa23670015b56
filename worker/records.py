"""Job records: what is stored of a job, and the interface of the store that keeps it.

The record is the authority on a job; RQ only carries its attempt id to a worker. Every change is a compare-and-set on the
record's version, and every change that an attempt makes checks the attempt id first (`pliant.worker.jobs.lifecycle`). An attempt
whose job was given to another attempt can therefore write nothing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from pliant.schemas.job import Job, Status
from pydantic import BaseModel, ConfigDict, Field

EVENTS_KEPT = 256
"""Events of one job that can be read again; older ones are dropped."""

EVENTS_KEPT_AT_LAST = 16
"""Events that are kept of a finished job: whoever follows it needs the last ones, and finished jobs are many."""

LOG_KEPT = 2000
"""Lines of one job's log; older ones are dropped."""


RUN_SECONDS = (1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
"""Upper bounds of the histogram of how long jobs ran, in seconds."""


class Webhook(BaseModel):
    """The address that is called when a job ends, and the secret that signs the message. Never returned to a client."""

    model_config = ConfigDict(frozen=True)

    url: str
    secret: str


class StoredShare(BaseModel):
    """A link that reads one job's results; its secret is stored as a digest."""

    model_config = ConfigDict(frozen=True)

    id: str
    digest: str
    """SHA-256 of the secret."""
    created_at: datetime
    expires_at: datetime


class Stored(BaseModel):
    """A job with what only the worker package needs."""

    model_config = ConfigDict(
        frozen=True, extra="ignore", validate_by_name=True, validate_by_alias=True, serialize_by_alias=True
    )

    job: Job
    owner: str = ""
    """Whose job it is, empty where there are no owners."""

    attempt_id: str = Field(validation_alias="token", serialization_alias="token")
    """The one attempt that may write: the id under which RQ carries the job. Every requeue changes it.
    Stored under the name `token`."""

    inputs: str
    """Blob of the canonical inputs."""

    result: str | None = None
    """Blob of the arrays of a stored result, for a job that writes further files of it instead of solving."""

    bytes: int = 0
    """Size of everything kept for the job."""

    prefix: str | None = None
    """Where the published artifacts lie among the blobs; None until the job has succeeded."""

    worker: str | None = None
    """Name of the worker that has it."""

    key: str | None = None
    """Digest of owner and idempotency key."""

    fingerprint: str | None = None
    """Digest of the request, to tell a repeated request from a different one under the same key or id."""

    webhook: Webhook | None = None
    """Called once the job has ended."""

    max_running: int | None = None
    """How many jobs of its owner may run at once, as the owner's token stated at submission; None: `Settings.max_running`."""

    shares: tuple[StoredShare, ...] = ()
    """Links that read the job's results without a token of its owner."""

    version: int = 0
    """Counts the changes; the compare-and-set compares it."""

    @property
    def sort_key(self) -> str:
        """Order of creation, ties broken by id."""
        return f"{int(self.job.created_at.timestamp() * 1000):014d}:{self.job.id}"


class Event(NamedTuple):
    """One change of a job, for those who follow it."""

    id: str
    """Ascending; pass the last one as `after`."""

    name: str
    """`job` when anything but the progress changed, else `progress`."""

    data: str
    """JSON of the `Job` or of its `Progress`."""


class Beat(NamedTuple):
    """The heartbeat count of a job, with what the reconciler needs besides."""

    attempt_id: str
    beats: int
    owner: str
    max_running: int | None
    """See `Stored`."""


Change = Callable[[Stored], Stored]


def event_of(before: Stored | None, after: Stored) -> tuple[str, str]:
    """Return name and data of the event that this change is."""
    if before is not None and after.job.progress is not None:
        still = {"progress": None}
        if before.job.model_copy(update=still) == after.job.model_copy(update=still):
            return "progress", after.job.progress.model_dump_json()
    return "job", after.job.model_dump_json()


def counted(before: Stored, after: Stored) -> dict[str, float]:
    """Return what to add to which tally because of this change: nothing, unless it ends the job.

    ``ended:<status>`` counts jobs, ``failed:<code>`` their reasons, ``ran:<status>:<bound>`` how many ran up to so many
    seconds and longer than the bound before, ``ran:<status>:sum`` the seconds of all.
    """
    job = after.job
    if before.job.status.final or not job.status.final:
        return {}
    adding: dict[str, float] = {f"ended:{job.status.value}": 1}
    if job.error is not None:
        adding[f"failed:{job.error.code}"] = 1
    if job.started_at is not None and job.finished_at is not None:
        seconds = max(0.0, (job.finished_at - job.started_at).total_seconds())
        bound = next((f"{each:g}" for each in RUN_SECONDS if seconds <= each), "+Inf")
        adding |= {f"ran:{job.status.value}:{bound}": 1, f"ran:{job.status.value}:sum": seconds}
    return adding


def webhook_due(before: Stored, after: Stored) -> int | None:
    """Return when the webhook of this change is due, in milliseconds since 1970; None if the change has none."""
    job = after.job
    if after.webhook is None or before.job.status.final or not job.status.final or job.finished_at is None:
        return None
    return milliseconds(job.finished_at)


def events_kept(after: Stored) -> int:
    """Return how many events to keep of a job that stands like this."""
    return EVENTS_KEPT_AT_LAST if after.job.status.final else EVENTS_KEPT


class Changes(ABC):
    """A subscription to the ids of changed jobs. Use it from one thread, and close it."""

    @abstractmethod
    def next(self, timeout: float) -> set[str]:
        """Wait up to `timeout` seconds for a change; return the ids of the jobs that changed, empty if none did.

        Raises
        ------
        StoreUnavailable
            The store does not answer.
        """

    @abstractmethod
    def close(self) -> None:
        """End the subscription."""


class Records(ABC):
    """A store of job records. One test suite runs on every implementation.

    Raises
    ------
    StoreUnavailable
        From every method, when the store does not answer.
    """

    @abstractmethod
    def create(self, stored: Stored, *, max_queued: int = 0, max_bytes: int = 0) -> Stored:
        """Write a new record, unless its idempotency key or its id is taken: then return the record that has it.

        Parameters
        ----------
        max_queued : int
            Jobs of this owner that may be queued at once, the new one among them; 0: any number.
        max_bytes : int
            Bytes that all jobs may hold together, the new one among them; 0: any number.

        Raises
        ------
        TooManyQueued, QuotaExceeded
            A limit is reached.
        """

    @abstractmethod
    def get(self, id: str) -> Stored:
        """Return a record.

        Raises
        ------
        UnknownJob
            There is none of that id.
        """

    @abstractmethod
    def find(self, key: str) -> Stored | None:
        """Return the record of an idempotency key's digest."""

    @abstractmethod
    def replace(self, before: Stored, after: Stored) -> bool:
        """Write `after` if the stored version is still `before`'s; tell whether it was."""

    @abstractmethod
    def delete(self, id: str, *, at: datetime) -> None:
        """Remove a record, its events, its log and its idempotency key, and note that its files are to be removed.

        Nothing happens if there is no such record.
        """

    @abstractmethod
    def deleted(self) -> dict[str, datetime]:
        """Return when each deleted job was deleted whose files are still to be removed."""

    @abstractmethod
    def forget_deleted(self, id: str) -> None:
        """Note that the files of a deleted job are removed."""

    @abstractmethod
    def page(
        self, *, cursor: str | None, limit: int, statuses: Sequence[Status], owner: str | None
    ) -> tuple[list[Stored], str | None]:
        """Return up to `limit` records, newest first, older than the cursor, and the next page's cursor."""

    @abstractmethod
    def ids(self, status: Status) -> list[str]:
        """Return every job id of one status, oldest first."""

    @abstractmethod
    def count(self, statuses: Sequence[Status], *, owner: str | None = None) -> int:
        """Return how many jobs have one of these statuses."""

    @abstractmethod
    def oldest(self, status: Status) -> datetime | None:
        """Return when the oldest job of one status was made, None if there is none."""

    @abstractmethod
    def tallies(self) -> dict[str, float]:
        """Return what has been counted since the installation began; see `counted` and `worker.outbox`."""

    @abstractmethod
    def used(self) -> int:
        """Return the bytes that all jobs hold together."""

    @abstractmethod
    def beat(self, id: str, attempt_id: str) -> Status | None:
        """Give a sign of life for an attempt; return the job's status, None if the attempt no longer owns the job."""

    @abstractmethod
    def look(self, id: str, attempt_id: str) -> Status | None:
        """Return the job's status, None if the attempt no longer owns the job; no sign of life."""

    @abstractmethod
    def beats(self, ids: Iterable[str]) -> dict[str, Beat]:
        """Return the count of signs of life of every job that is there."""

    @abstractmethod
    def events(self, id: str, *, after: str | None) -> list[Event]:
        """Return the job's events after one id (None: all that are kept)."""

    @abstractmethod
    def changes(self) -> Changes:
        """Subscribe to the ids of changed jobs."""

    @abstractmethod
    def append_log(self, id: str, lines: Sequence[str]) -> None:
        """Add lines to a job's log; a job that is gone gets none."""

    @abstractmethod
    def log(self, id: str) -> list[str]:
        """Return a job's log."""

    @abstractmethod
    def ping(self) -> None:
        """Return if the store answers."""

    def update(self, id: str, change: Change) -> Stored:
        """Apply a change to a record, again on the newer record whenever somebody else was quicker.

        Parameters
        ----------
        change : callable
            Pure function of the stored record; its exceptions pass through, and nothing is written then. Returning
            the record it was given means that there is nothing to write.

        Raises
        ------
        UnknownJob
            There is no record of that id.
        """
        while True:
            before = self.get(id)
            changed = change(before)
            if changed is before:
                return before
            after = changed.model_copy(update={"version": before.version + 1})
            if self.replace(before, after):
                return after


def utc_now() -> datetime:
    """Return the time."""
    return datetime.now(UTC)


def milliseconds(moment: datetime) -> int:
    """Return a moment as whole milliseconds since 1970."""
    return int(moment.timestamp() * 1000)


def moment(since: int) -> datetime:
    """Return the moment that is so many milliseconds after 1970 began."""
    return datetime.fromtimestamp(since / 1000, UTC)

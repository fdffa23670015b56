"""Job records, and the interface of their store.

The record is the authority on a job; RQ only carries its attempt id to a worker. Every change is a compare-and-set on the
record's version, and changes by an attempt also check the attempt id (`pliant.worker.jobs.lifecycle`). An attempt whose job
was requeued can therefore write nothing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from pliant.schemas.job import Job, Priority, Status
from pydantic import BaseModel, ConfigDict, Field

EVENTS_KEPT = 256
"""Maximum number of events kept per job; older ones are dropped."""

EVENTS_KEPT_AT_LAST = 16
"""Maximum number of events kept per finished job: followers need the last ones only."""

LOG_KEPT = 2000
"""Maximum number of lines of a job's log; older ones are dropped."""


RUN_SECONDS = (1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
"""Upper bounds of the histogram of job durations, seconds."""


class Webhook(BaseModel):
    """Address called when a job ends, and the secret for its signature. Never returned to clients."""

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
    """A job with the internal fields of the worker package."""

    model_config = ConfigDict(
        frozen=True, extra="ignore", validate_by_name=True, validate_by_alias=True, serialize_by_alias=True
    )

    job: Job
    owner: str = ""
    """Owner of the job, empty without authentication."""

    attempt_id: str = Field(validation_alias="token", serialization_alias="token")
    """The only attempt that may write; RQ carries this id. Every requeue changes it.
    Stored under the name `token`."""

    inputs: str
    """Blob of the canonical inputs."""

    result: str | None = None
    """Blob with the arrays of a stored result, for a job that writes further files from it instead of solving."""

    bytes: int = 0
    """Total size of the job's files, bytes; of an unfinished job with what is reserved for its results."""

    reserved: int = 0
    """Bytes that are reserved for the results of an unfinished job, if there is a disk quota."""

    prefix: str | None = None
    """Blob prefix of the published artifacts; None until the job has succeeded."""

    worker: str | None = None
    """Name of the worker that runs the job."""

    stops: int = 0
    """Attempts that ended because the installation was stopped or restored; they do not count against `Settings.max_attempts`."""

    key: str | None = None
    """Digest of owner and idempotency key."""

    fingerprint: str | None = None
    """Digest of the request, which distinguishes a repeated request from a different one with the same key or id."""

    webhook: Webhook | None = None
    """Called once the job has ended."""

    max_running: int | None = None
    """Limit of concurrently running jobs of the owner, from the token at submission; None: `Settings.max_running`."""

    shares: tuple[StoredShare, ...] = ()
    """Links that read the job's results without a token of its owner."""

    trace: str | None = None
    """W3C `traceparent` of the request that created the job, which its attempts continue; None: not traced."""

    version: int = 0
    """Number of changes, for the compare-and-set."""

    record_schema: int = Field(2, validation_alias="schema", serialization_alias="schema")
    """Version of the record's format; see `pliant.worker.store.schema`."""

    @property
    def sort_key(self) -> str:
        """Order of creation, ties broken by id."""
        return f"{milliseconds(self.job.created_at):014d}:{self.job.id}"


class Event(NamedTuple):
    """One change of a job, for followers."""

    id: str
    """Increasing; pass the last one as `after`."""

    name: str
    """`job` when anything but the progress changed, else `progress`."""

    data: str
    """JSON of the `Job` or of its `Progress`."""


class Heartbeat(NamedTuple):
    """The heartbeat count of a job, with further fields for the reconciler."""

    attempt_id: str
    beats: int
    owner: str
    max_running: int | None
    """See `Stored`."""
    priority: Priority
    """Priority of the job among its owner's waiting jobs."""


Change = Callable[[Stored], Stored]


def event_of(before: Stored | None, after: Stored) -> tuple[str, str] | None:
    """Return name and data of the event for this change; None if the job had already ended, since its last event says so."""
    if before is not None and before.job.status.final and after.job.status.final:
        return None
    if before is not None and after.job.progress is not None:
        still = {"progress": None}
        if before.job.model_copy(update=still) == after.job.model_copy(update=still):
            return "progress", after.job.progress.model_dump_json()
    return "job", after.job.model_dump_json()


def counted(before: Stored, after: Stored) -> dict[str, float]:
    """Return the increments of the counters for this change: none, unless it ends the job.

    ``ended:<status>`` counts jobs, ``failed:<code>`` their errors, ``ran:<status>:<bound>`` the jobs of a histogram bin with
    this upper bound in seconds, ``ran:<status>:sum`` the seconds of all.
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
    """Return the maximum number of events to keep for a job in this state."""
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
        """Close the subscription."""


class Records(ABC):
    """A store of job records. One test suite runs on every implementation.

    Raises
    ------
    StoreUnavailable
        From every method, when the store does not answer.
    """

    @abstractmethod
    def create(self, stored: Stored, *, max_queued: int = 0, max_bytes: int = 0) -> Stored:
        """Write a new record; if its idempotency key or id is taken, return the existing record instead.

        `max_queued` limits the queued jobs of this owner, `max_bytes` the bytes of all jobs, the new one included; 0: no limit.

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
            No job has this id.
        """

    @abstractmethod
    def find(self, key: str) -> Stored | None:
        """Return the record with this digest of an idempotency key, None if there is none."""

    @abstractmethod
    def replace(self, before: Stored, after: Stored) -> bool:
        """Write `after` if the stored version is still that of `before`; return whether it was written."""

    @abstractmethod
    def delete(self, stored: Stored, *, at: datetime) -> None:
        """Remove a record with its events, log and idempotency key, and mark its files for removal.

        Nothing happens if it was removed already, even if a new job has its id.
        """

    @abstractmethod
    def deleted(self) -> dict[str, datetime]:
        """Return the deletion times of deleted jobs whose files are not removed yet."""

    @abstractmethod
    def forget_deleted(self, id: str) -> None:
        """Remove the mark of a deleted job whose files are removed."""

    @abstractmethod
    def page(
        self, *, cursor: str | None, limit: int, statuses: Sequence[Status], owner: str | None
    ) -> tuple[list[Stored], str | None]:
        """Return up to `limit` records older than the cursor, newest first, and the next page's cursor, None on the last page."""

    @abstractmethod
    def ids(self, *statuses: Status) -> list[str]:
        """Return every job id of some statuses at one moment, one status after the other, each with the oldest first."""

    @abstractmethod
    def count(self, statuses: Sequence[Status], *, owner: str | None = None) -> int:
        """Return the number of jobs with one of these statuses."""

    @abstractmethod
    def oldest(self, status: Status) -> datetime | None:
        """Return the creation time of the oldest job of one status, None if there is none."""

    @abstractmethod
    def tallies(self) -> dict[str, float]:
        """Return the counters since the installation was created; see `counted` and `pliant.worker.store.outbox`."""

    @abstractmethod
    def used(self) -> int:
        """Return the total bytes of all jobs."""

    @abstractmethod
    def beat(self, id: str, attempt_id: str) -> Status | None:
        """Write a heartbeat for an attempt; return the job's status, None if the attempt no longer owns the job."""

    @abstractmethod
    def look(self, id: str, attempt_id: str) -> Status | None:
        """Return the job's status without a heartbeat, None if the attempt no longer owns the job."""

    @abstractmethod
    def beats(self, ids: Iterable[str]) -> dict[str, Heartbeat]:
        """Return the heartbeat counts of the jobs that exist."""

    @abstractmethod
    def events(self, id: str, *, after: str | None) -> list[Event]:
        """Return the job's events after the id `after`; None: all that are kept."""

    @abstractmethod
    def changes(self) -> Changes:
        """Subscribe to the ids of changed jobs."""

    @abstractmethod
    def append_log(self, id: str, lines: Sequence[str]) -> None:
        """Append lines to a job's log; nothing happens if the job was deleted."""

    @abstractmethod
    def log(self, id: str) -> list[str]:
        """Return a job's log."""

    @abstractmethod
    def ping(self) -> None:
        """Return normally if the store answers."""

    def update(self, id: str, change: Change) -> Stored:
        """Apply the pure function `change` to a record; after a concurrent write, apply it again to the newer record.

        Nothing is written if `change` raises an exception, which propagates, or returns its argument.

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
    """Return the current time in UTC."""
    return datetime.now(UTC)


def dated(text: str) -> list[str]:
    """Return the lines of an entry of a job's log, each with the current time."""
    moment = utc_now().strftime("%Y-%m-%dT%H:%M:%SZ")
    return [f"{moment} {line}" for line in text.splitlines()]


def milliseconds(moment: datetime) -> int:
    """Return a time as whole milliseconds since 1970."""
    return int(moment.timestamp() * 1000)


def moment(since: int) -> datetime:
    """Return the time from milliseconds since 1970."""
    return datetime.fromtimestamp(since / 1000, UTC)

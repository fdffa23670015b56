"""Everything a service may do with jobs, behind one door."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pliant.schemas.job import Artifact, Job, JobPage, Status
from pliant.worker.errors import NotAllowedNow, StoreUnavailable, UnknownArtifact
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.intake import Intake
from pliant.worker.jobs.validation import LARGEST_PAGE as LARGEST_PAGE
from pliant.worker.jobs.validation import check_event_id, check_page
from pliant.worker.records import Event
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blob, Blobs
from pliant.worker.store.connection import BLOCK_WITHIN, connect
from pliant.worker.store.queue import RedisQueue
from pliant.worker.store.redis import RedisRecords


@dataclass(frozen=True, slots=True, kw_only=True)
class Jobs(Intake):
    """Jobs of one owner, or of everybody: taken in (see `Intake`), looked at, ended, removed.

    Every method may raise `StoreUnavailable`, and every one that takes an id `UnknownJob`.
    """

    @classmethod
    def open(cls, settings: Settings) -> Jobs:
        """Connect to what the settings name. Nothing is sent before it is needed, so Redis may still be starting."""
        return cls(
            records=RedisRecords(
                connect(settings.redis, decode=True),
                prefix=settings.queue,
                waiting=connect(settings.redis, decode=True, answer_within=BLOCK_WITHIN),
            ),
            blobs=Blobs.open(settings.blobs),
            queue=RedisQueue(connect(settings.redis, decode=False), name=settings.queue),
            settings=settings,
        )

    def of(self, owner: str) -> Jobs:
        """Return the same jobs as this owner sees them."""
        return replace(self, owner=owner)

    def get(self, id: str) -> Job:
        """Return a job."""
        return self._placed(self._stored(id))

    def page(self, *, cursor: str | None = None, limit: int = 50, statuses: Sequence[Status] | None = None) -> JobPage:
        """Return jobs, newest first.

        Parameters
        ----------
        cursor : str, optional
            `JobPage.next` of the page before.
        limit : int
            1–200.
        statuses : sequence of Status, optional
            Only these.

        Raises
        ------
        InvalidRequest
            The cursor is not one, or the limit is out of range.
        """
        check_page(cursor, limit)
        wanted = tuple(Status) if statuses is None else tuple(statuses)
        found, following = self.records.page(cursor=cursor, limit=limit, statuses=wanted, owner=self.owner)
        places: dict[str, int] = {}
        if any(each.job.status is Status.QUEUED for each in found):
            places = {token: place for place, token in enumerate(self.queue.waiting())}
        jobs = [
            each.job.model_copy(update={"place_in_queue": places.get(each.token)})
            if each.job.status is Status.QUEUED
            else each.job
            for each in found
        ]
        return JobPage(jobs=jobs, next=following)

    def count(self, statuses: Sequence[Status]) -> int:
        """Return how many jobs have one of these statuses."""
        return self.records.count(statuses, owner=self.owner)

    def cancel(self, id: str) -> Job:
        """Ask a job to end: a queued one is cancelled at once, a running one is `cancelling` until it has stopped.

        Raises
        ------
        NotAllowedNow
            The job has succeeded or failed.
        """
        token = self._stored(id).token
        after = self.records.update(
            id, lambda stored: lifecycle.cancel(stored, now=self.clock(), retention=self.settings.retention)
        )
        if after.job.status is Status.CANCELLED:
            self.queue.remove(token)
        return after.job

    def delete(self, id: str) -> None:
        """Remove a finished job, its record and its files.

        Raises
        ------
        NotAllowedNow
            The job is not finished.
        """
        stored = self._stored(id)
        if not stored.job.status.final:
            raise NotAllowedNow(id, stored.job.status, wanted="deleted", hint="Cancel it first.")
        self.records.delete(id)
        self.blobs.delete(f"jobs/{id}/")

    def artifact(self, id: str, name: str) -> tuple[Artifact, Blob]:
        """Return a result file's description and its bytes, readable in ranges.

        Raises
        ------
        UnknownArtifact
            The job has no file of that name, or no files yet.
        """
        stored = self._stored(id)
        for each in stored.job.artifacts:
            if each.name == name and stored.prefix is not None:
                return each, self.blobs.get(f"{stored.prefix}{name}")
        raise UnknownArtifact(id, name, names=[each.name for each in stored.job.artifacts])

    def log(self, id: str) -> str:
        """Return what the job's attempts have logged so far."""
        self._stored(id)
        return "".join(f"{line}\n" for line in self.records.log(id))

    def events(self, id: str, *, after: str | None = None, timeout: float = 10.0) -> list[Event]:
        """Return the job's changes after one of them, waiting for the first one; an empty list means nothing happened.

        The last event of a finished job is a `job` event with a final status; nothing follows it.

        Parameters
        ----------
        after : str, optional
            `Event.id`; None returns all that are kept (the latest 256; of a finished job the latest 16).
        timeout : float
            Seconds to wait, at most 20.

        Raises
        ------
        InvalidRequest
            `after` is not an event's id.
        """
        if after is not None:
            check_event_id(after)
        self._stored(id)
        return self.records.events(id, after=after, timeout=timeout)

    def used(self) -> int:
        """Return the bytes that everybody's jobs hold together."""
        return self.records.used()

    def ready(self) -> dict[str, str]:
        """Return for `redis`, `blobs` and `workers` the word `ok`, or a sentence that says what is wrong."""
        found: dict[str, str] = {}
        for part, check in (("redis", self.records.ping), ("blobs", self.blobs.check)):
            try:
                check()
                found[part] = "ok"
            except StoreUnavailable as error:
                found[part] = str(error)
        try:
            workers = self.queue.workers()
            found["workers"] = "ok" if workers else "No worker is running; start one with `pliant work`."
        except StoreUnavailable as error:
            found["workers"] = str(error)
        return found

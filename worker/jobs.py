"""Everything a service may do with jobs, behind one door."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from pliant.client.options import Options
from pliant.client.schemas import Artifact, Interpretation, Job, JobPage, Status
from pliant.worker import lifecycle
from pliant.worker.blobs import Blob, Blobs
from pliant.worker.checks import LARGEST_PAGE as LARGEST_PAGE
from pliant.worker.checks import check_event_id, check_id, check_key, check_page, is_id
from pliant.worker.connection import BLOCK_WITHIN, connect
from pliant.worker.errors import (
    Conflict,
    NotAllowedNow,
    QuotaExceeded,
    StoreUnavailable,
    TooManyQueued,
    UnknownArtifact,
    UnknownJob,
)
from pliant.worker.queue import Queue, RedisQueue
from pliant.worker.records import Event, Records, Stored, Webhook, new_token
from pliant.worker.redis_records import RedisRecords
from pliant.worker.settings import Settings


def utc_now() -> datetime:
    """Return the time."""
    return datetime.now(UTC)


@dataclass(frozen=True, slots=True, kw_only=True)
class Jobs:
    """Jobs of one owner, or of everybody.

    Every method may raise `StoreUnavailable`, and every one that takes an id `UnknownJob`.
    """

    records: Records
    blobs: Blobs
    queue: Queue
    settings: Settings
    owner: str | None = None
    """None: everybody's jobs; otherwise those of this owner, and to him there are no others."""
    max_queued: int = 0
    """Jobs of one owner that may wait at once; 0: any number."""
    max_running: int | None = None
    """Jobs of one owner that may run at once; 0: any number; None: what the settings say."""
    clock: Callable[[], datetime] = utc_now

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

    def submit(
        self,
        inputs_file: Path,
        *,
        options: Options,
        interpretation: Interpretation,
        name: str = "",
        id: str | None = None,
        idempotency_key: str | None = None,
        fingerprint: str | None = None,
        webhook: Webhook | None = None,
    ) -> Job:
        """Accept a job: once this returns, it will be done or end with a reason, whatever is killed meanwhile.

        Parameters
        ----------
        inputs_file : Path
            Canonical inputs, as `worker.formats.save_inputs` writes them; copied, the caller may remove it.
        id : str, optional
            The caller's own id: 3–64 letters, digits, underscores, dashes.
        idempotency_key : str, optional
            A repeated request with the same key returns the first job; keys live as long as their job.
        fingerprint : str, optional
            Digest of the whole request, by which a repeated request is told from a different one.
        webhook : Webhook, optional
            Whom to tell when the job has ended.

        Raises
        ------
        Conflict
            The id or the key belongs to a different request.
        InvalidRequest
            The id or the key cannot be one.
        QuotaExceeded
            The jobs together hold as many bytes as they may.
        TooManyQueued
            As many jobs of this owner wait as may.
        """
        known = self.known(id=id, idempotency_key=idempotency_key, fingerprint=fingerprint)
        if known is not None:
            return known
        self._check_quota(inputs_file.stat().st_size)
        job_id = id or secrets.token_hex(10)
        job = Job(
            id=job_id,
            name=name,
            status=Status.QUEUED,
            created_at=self.clock(),
            options=options,
            interpretation=interpretation,
        )
        return self._create(
            job,
            lambda key: self.blobs.put(key, inputs_file),
            key=self._digest(idempotency_key),
            fingerprint=fingerprint,
            webhook=webhook,
        )

    def known(
        self,
        *,
        id: str | None = None,
        idempotency_key: str | None = None,
        fingerprint: str | None = None,
    ) -> Job | None:
        """Return the job that a repeated request has already made, None if the request is new. Raises as `submit`."""
        if id is not None:
            check_id(id)
        if idempotency_key is not None:
            check_key(idempotency_key)
        digest = self._digest(idempotency_key)
        found = self.records.find(digest) if digest is not None else None
        if found is None and id is not None:
            try:
                found = self.records.get(id)
            except UnknownJob:
                return None
        return None if found is None else self._same(found, fingerprint, wanted=id)

    def check_room(self, *, id: str | None = None, idempotency_key: str | None = None) -> None:
        """Return if a submission would find room, before its inputs are even received.

        A repeated request is let through: it makes no new job. What is decided here is decided again, without a gap, when
        the record is written.

        Raises
        ------
        TooManyQueued
            As many jobs of this owner wait as may.
        """
        if not 0 < self.max_queued <= self.records.count([Status.QUEUED], owner=self.owner or ""):
            return
        digest = self._digest(idempotency_key)
        if digest is not None and self.records.find(digest) is not None:
            return
        try:
            self.records.get(id or "")
        except UnknownJob:
            raise TooManyQueued(self.max_queued) from None

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

    def retry(self, id: str, *, idempotency_key: str | None = None) -> Job:
        """Run a failed or cancelled job again, as a new job with the same inputs, options, name and webhook.

        Parameters
        ----------
        idempotency_key : str, optional
            A repeated request with the same key returns the first new job.

        Raises
        ------
        Conflict
            The key belongs to a different request.
        InvalidRequest
            The key cannot be one.
        NotAllowedNow
            The job is not finished, or has succeeded.
        """
        stored = self._stored(id)
        job = stored.job
        fingerprint = hashlib.sha256(f"retry of {id}".encode()).hexdigest()
        known = self.known(idempotency_key=idempotency_key, fingerprint=fingerprint)
        if known is not None:
            return known
        if job.status not in (Status.FAILED, Status.CANCELLED):
            hint = "It has its result." if job.status is Status.SUCCEEDED else "Wait until it ends, or cancel it first."
            raise NotAllowedNow(id, job.status, wanted="run again", hint=hint)
        size = self._size(stored.inputs)
        self._check_quota(size)
        again = Job(
            id=secrets.token_hex(10),
            name=job.name,
            status=Status.QUEUED,
            created_at=self.clock(),
            retry_of=id,
            options=job.options,
            interpretation=job.interpretation,
        )

        def copy(key: str) -> int:
            self.blobs.copy(stored.inputs, key)
            return size

        return self._create(
            again,
            copy,
            key=self._digest(idempotency_key),
            fingerprint=fingerprint,
            owner=stored.owner,
            webhook=stored.webhook,
        )

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

    def _stored(self, id: str) -> Stored:
        if not is_id(id):
            raise UnknownJob(id[:80])
        stored = self.records.get(id)
        if self.owner is not None and stored.owner != self.owner:
            raise UnknownJob(id)
        return stored

    def _create(
        self,
        job: Job,
        put: Callable[[str], int],
        *,
        key: str | None,
        fingerprint: str | None,
        owner: str | None = None,
        webhook: Webhook | None = None,
    ) -> Job:
        """Blobs, then record, then queue: whatever fails between leaves nothing that is promised and not there."""
        token = new_token(job.id)
        inputs = f"jobs/{job.id}/{token}/inputs.npz"
        size = put(inputs)
        mine = Stored(
            job=job,
            owner=owner if owner is not None else self.owner or "",
            token=token,
            inputs=inputs,
            bytes=size,
            key=key,
            fingerprint=fingerprint,
            webhook=webhook,
            max_running=self.max_running,
        )
        try:
            kept = self.records.create(mine, max_queued=self.max_queued)
        except TooManyQueued:
            self.blobs.delete(inputs)
            raise
        if kept.inputs != inputs:
            self.blobs.delete(inputs)
            return self._same(kept, fingerprint, wanted=job.id)
        try:
            if self._held_back(mine.owner):
                self.queue.hold(token)
            else:
                self.queue.push(job.id, token)
        except StoreUnavailable:
            return job  # the record is safe, and the keeper queues what the queue does not know
        return self._placed(mine)

    def _held_back(self, owner: str) -> bool:
        """Tell whether a job just made has to wait until fewer of its owner's run; the keeper queues it then.

        Counted after the record was written, so two submissions at once cannot both miss each other.
        """
        most = self.settings.max_running if self.max_running is None else self.max_running
        unfinished = (Status.QUEUED, Status.RUNNING, Status.CANCELLING)
        return most > 0 and self.records.count(unfinished, owner=owner) > most

    def _same(self, found: Stored, fingerprint: str | None, *, wanted: str | None) -> Job:
        """Return the job of a repeated request, or refuse a different one."""
        mine = self.owner is None or found.owner == self.owner
        if mine and fingerprint is not None and found.fingerprint == fingerprint:
            return self._placed(found)
        if found.job.id == wanted:
            sentence = f"The id {wanted!r} is already used by a different job. Choose another id."
            raise Conflict("id_taken", id=wanted, sentence=sentence)
        sentence = (
            f"This Idempotency-Key was used for a different request, which made job {found.job.id!r}. Use a new key."
        )
        raise Conflict("idempotency_conflict", id=found.job.id, sentence=sentence)

    def _placed(self, stored: Stored) -> Job:
        if stored.job.status is not Status.QUEUED:
            return stored.job
        return stored.job.model_copy(update={"place_in_queue": self.queue.place(stored.token)})

    def _digest(self, idempotency_key: str | None) -> str | None:
        if idempotency_key is None:
            return None
        return hashlib.sha256(f"{self.owner or ''}\n{idempotency_key}".encode()).hexdigest()

    def _size(self, key: str) -> int:
        return self.blobs.get(key).size

    def _check_quota(self, more: int) -> None:
        quota = self.settings.disk_quota
        if quota > 0 and (used := self.records.used()) + more > quota:
            raise QuotaExceeded(used=used, quota=quota)

"""The operations on jobs that the service offers: submit, look, list, cancel, run again, delete."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from pliant.schemas.job import Artifact, Interpretation, Job, JobPage, Status
from pliant.worker.errors import (
    Conflict,
    NotAllowedNow,
    StoreUnavailable,
    TooManyQueued,
    UnknownArtifact,
    UnknownJob,
)
from pliant.worker.ids import check_id, is_id, new_attempt_id, new_job_id
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.admission import check_fits
from pliant.worker.jobs.submission import Acceptance, Submission, key_digest
from pliant.worker.jobs.validation import LARGEST_PAGE as LARGEST_PAGE
from pliant.worker.jobs.validation import check_event_id, check_key, check_page
from pliant.worker.paths import make_data_directory
from pliant.worker.records import Event, Records, Stored, utc_now
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blob, Blobs
from pliant.worker.store.connection import connect
from pliant.worker.store.queue import Queue, RedisQueue
from pliant.worker.store.redis import RedisRecords


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
    """None: everybody's jobs; otherwise this owner's alone, and the others do not exist for it."""
    max_queued: int = 0
    """Jobs of one owner that may be queued at once; 0: any number."""
    max_running: int | None = None
    """Jobs of one owner that may run at once; 0: any number; None: `Settings.max_running`."""
    clock: Callable[[], datetime] = utc_now

    @classmethod
    def open(cls, settings: Settings) -> Jobs:
        """Connect to what the settings name. Nothing is sent before it is needed, so Redis may still be starting."""
        if settings.blob_url is None:
            with suppress(OSError):  # what is wrong is said by what opens it
                make_data_directory(settings.data)
        return cls(
            records=RedisRecords(connect(settings.redis, decode=True), prefix=settings.queue),
            blobs=Blobs.open(settings.blobs),
            queue=RedisQueue(connect(settings.redis, decode=False), name=settings.queue),
            settings=settings,
        )

    def of(self, owner: str) -> Jobs:
        """Return the same jobs as this owner sees them."""
        return replace(self, owner=owner)

    def submit(self, inputs_file: Path, submission: Submission, *, interpretation: Interpretation) -> Job:
        """Accept a job. Once this returns, the job will end with a result or a reason, whichever process is killed.

        Parameters
        ----------
        inputs_file : Path
            Canonical inputs, as `worker.formats.save_inputs` writes them. Linked or copied; the caller may remove the
            name, and must not write to the file.
        submission : Submission
            What the client asks for.
        interpretation : Interpretation
            How the inputs were read.

        Raises
        ------
        Conflict
            The id or the key belongs to a different request.
        InvalidRequest
            The id or the key is malformed, or no worker has the memory that the job needs.
        QuotaExceeded
            Jobs and uploads hold as many bytes as they may.
        TooManyQueued
            As many jobs of this owner are queued as may be.
        """
        known = self.known(submission)
        if known is not None:
            return known
        job = Job(
            id=submission.id or new_job_id(),
            name=submission.name,
            priority=submission.priority,
            status=Status.QUEUED,
            created_at=self.clock(),
            options=submission.options,
            interpretation=interpretation,
        )
        check_fits(interpretation, submission.options, self.queue.memories().values())
        size = inputs_file.stat().st_size
        return self._create(job, submission, lambda key: self.blobs.put(key, inputs_file), size=size)

    def known(self, submission: Submission) -> Job | None:
        """Return the job that a repeated request has already made, None if the request is new. Raises as `submit`."""
        if submission.id is not None:
            check_id(submission.id)
        if submission.idempotency_key is not None:
            check_key(submission.idempotency_key)
        digest = key_digest(submission.idempotency_key, self.owner)
        found = self.records.find(digest) if digest is not None else None
        if found is None and submission.id is not None:
            with suppress(UnknownJob):
                found = self.records.get(submission.id)
        return None if found is None else self._same(found, submission)

    def check_capacity(self, *, id: str | None = None, idempotency_key: str | None = None) -> None:
        """Check that the queue has a place for a submission, before its inputs are received.

        A repeated request passes: it makes no new job. The limit is checked again, atomically, when the record is written.

        Raises
        ------
        TooManyQueued
            As many jobs of this owner are queued as may be.
        """
        if not 0 < self.max_queued <= self.records.count([Status.QUEUED], owner=self.owner or ""):
            return
        digest = key_digest(idempotency_key, self.owner)
        if digest is not None and self.records.find(digest) is not None:
            return
        try:
            self.records.get(id or "")
        except UnknownJob:
            raise TooManyQueued(self.max_queued) from None

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
            The key is malformed.
        NotAllowedNow
            The job is not finished, or has succeeded.
        UnknownJob
            There is no such job, or it was deleted meanwhile.
        """
        stored = self._stored(id)
        job = stored.job
        submission = Submission(
            options=job.options, name=job.name, idempotency_key=idempotency_key, webhook=stored.webhook,
            fingerprint=hashlib.sha256(f"retry of {id}".encode()).hexdigest(),
        )  # fmt: skip
        known = self.known(submission)
        if known is not None:
            return known
        if job.status not in (Status.FAILED, Status.CANCELLED):
            hint = "It has its result." if job.status is Status.SUCCEEDED else "Wait until it ends, or cancel it first."
            raise NotAllowedNow(id, job.status, wanted="run again", hint=hint)
        again = Job(
            id=new_job_id(),
            name=job.name,
            status=Status.QUEUED,
            created_at=self.clock(),
            retry_of=id,
            priority=job.priority,
            options=job.options,
            interpretation=job.interpretation,
        )
        try:
            size = self.blobs.get(stored.inputs).size
            return self._create(
                again, submission, lambda key: self.blobs.copy(stored.inputs, key), size=size, owner=stored.owner
            )
        except FileNotFoundError:  # deleted between our look and the copy
            raise UnknownJob(id) from None

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
            places = {attempt_id: place for place, attempt_id in enumerate(self.queue.waiting())}
        jobs = [
            each.job.model_copy(update={"place_in_queue": places.get(each.attempt_id)})
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
        attempt_id = self._stored(id).attempt_id
        after = self.records.update(
            id, lambda stored: lifecycle.cancel(stored, now=self.clock(), retention=self.settings.retention)
        )
        if after.job.status is Status.CANCELLED:
            self.queue.remove(attempt_id)
        return after.job

    def delete(self, id: str) -> None:
        """Remove a finished job, its record and its files. Files that cannot be removed now are removed by the reconciler.

        Raises
        ------
        NotAllowedNow
            The job is not finished.
        """
        stored = self._stored(id)
        if not stored.job.status.final:
            raise NotAllowedNow(id, stored.job.status, wanted="deleted", hint="Cancel it first.")
        self.records.delete(id, at=self.clock())
        with suppress(StoreUnavailable):
            self.blobs.delete(f"jobs/{id}/")
            self.records.forget_deleted(id)

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

    def events(self, id: str, *, after: str | None = None) -> list[Event]:
        """Return the job's changes after one of them; `records.changes` reports when there are new ones.

        The last event of a finished job is a `job` event with a final status; nothing follows it.

        Parameters
        ----------
        after : str, optional
            `Event.id`; None returns all that are kept (the latest 256; of a finished job the latest 16).

        Raises
        ------
        InvalidRequest
            `after` is not an event's id.
        """
        if after is not None:
            check_event_id(after)
        self._stored(id)
        return self.records.events(id, after=after)

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
        self, job: Job, submission: Submission, put: Callable[[str], object], *, size: int, owner: str | None = None
    ) -> Job:
        acceptance = Acceptance(records=self.records, blobs=self.blobs, queue=self.queue, settings=self.settings)
        acceptance.check_quota(size)
        attempt_id = new_attempt_id(job.id)
        stored = Stored(
            job=job,
            owner=owner if owner is not None else self.owner or "",
            attempt_id=attempt_id,
            inputs=f"jobs/{job.id}/{attempt_id}/inputs.npz",
            bytes=size,
            key=key_digest(submission.idempotency_key, self.owner),
            fingerprint=submission.fingerprint,
            webhook=submission.webhook,
            max_running=self.max_running,
        )
        kept = acceptance.create(stored, put, max_queued=self.max_queued)
        return self._placed(kept) if kept.inputs == stored.inputs else self._same(kept, submission, wanted=job.id)

    def _same(self, found: Stored, submission: Submission, *, wanted: str | None = None) -> Job:
        """Return the job of a repeated request, or refuse a different one."""
        mine = self.owner is None or found.owner == self.owner
        if mine and submission.fingerprint is not None and found.fingerprint == submission.fingerprint:
            return self._placed(found)
        wanted = wanted or submission.id
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
        try:
            place = self.queue.place(stored.attempt_id)
        except StoreUnavailable:
            return stored.job
        return stored.job.model_copy(update={"place_in_queue": place})

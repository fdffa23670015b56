"""The operations on jobs: submit, get, list, cancel, delete; read artifacts, log and events."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from pliant.schemas.job import Artifact, Interpretation, Job, JobPage, Status
from pliant.worker import tracing
from pliant.worker.errors import NotAllowedNow, StoreUnavailable, Taken, TooManyQueued, UnknownArtifact, UnknownJob
from pliant.worker.formats.cost import expected_files
from pliant.worker.ids import check_id, is_id, new_attempt_id, new_job_id
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.admission import check_fits
from pliant.worker.jobs.submission import Submission, accept, folder_of, key_digest
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
    """Jobs of one owner, or of all owners.

    Every method may raise `StoreUnavailable`; those that take an id may raise `UnknownJob`.
    """

    records: Records
    blobs: Blobs
    queue: Queue
    settings: Settings
    owner: str | None = None
    """Owner whose jobs are visible; None: jobs of all owners."""
    max_queued: int = 0
    """Maximum number of queued jobs per owner; 0: no limit."""
    max_running: int | None = None
    """Maximum number of running jobs per owner; 0: no limit; None: `Settings.max_running`."""
    clock: Callable[[], datetime] = utc_now

    @classmethod
    def open(cls, settings: Settings) -> Jobs:
        """Open the stores named by the settings. Connections are made on first use, so Redis may still be starting."""
        if settings.blob_url is None:
            with suppress(OSError):  # opening the store reports the error
                make_data_directory(settings.data)
        return cls(
            records=RedisRecords(connect(settings.redis, decode=True), prefix=settings.queue),
            blobs=Blobs.open(settings.blobs),
            queue=RedisQueue(connect(settings.redis, decode=False), name=settings.queue),
            settings=settings,
        )

    def of(self, owner: str) -> Jobs:
        """Return the jobs of this owner."""
        return replace(self, owner=owner)

    def submit(self, inputs_file: Path, submission: Submission, *, interpretation: Interpretation) -> tuple[Job, bool]:
        """Accept a job; return it, and whether it is new: False for that of an earlier or simultaneous equal request.

        Once this returns, the job will end with a result or an error, even if processes are killed.

        The canonical inputs, as `worker.formats.save_inputs` writes them, are linked or copied: the caller may unlink the file,
        but must not write to it.

        Raises
        ------
        Conflict
            The id or the key belongs to a different request.
        InvalidRequest
            The id or the key is malformed, or no worker has the memory that the job needs.
        QuotaExceeded
            Jobs and uploads have reached the disk quota.
        TooManyQueued
            The owner's limit on queued jobs is reached.
        """
        known = self.known(submission)
        if known is not None:
            return known, False
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
        """Return the job of an earlier identical request, None if the request is new. Raises the errors of `submit`."""
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
        """Check the limit on queued jobs before the inputs of a submission are received.

        A repeated request passes, since it creates no job. The limit is checked again, atomically, when the record is written.

        Raises
        ------
        TooManyQueued
            The owner's limit on queued jobs is reached.
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

    def get(self, id: str) -> Job:
        """Return a job."""
        return self._placed(self.stored(id))

    def page(self, *, cursor: str | None = None, limit: int = 50, statuses: Sequence[Status] | None = None) -> JobPage:
        """Return a page of jobs, newest first. `cursor` is `next` of the previous page; `statuses` defaults to all.

        Raises
        ------
        InvalidRequest
            The cursor is malformed, or the limit is not 1–200.
        """
        check_page(cursor, limit)
        wanted = tuple(Status) if statuses is None else tuple(statuses)
        found, following = self.records.page(cursor=cursor, limit=limit, statuses=wanted, owner=self.owner)
        places: dict[str, int | None] = {}
        if any(each.job.status is Status.QUEUED for each in found):
            places = {attempt_id: place for place, attempt_id in enumerate(self.queue.waiting())}
            places |= dict.fromkeys(self.queue.held())
        jobs = [
            # 0: a worker has just taken it.
            each.job.model_copy(update={"place_in_queue": places.get(each.attempt_id, 0)})
            if each.job.status is Status.QUEUED
            else each.job
            for each in found
        ]
        return JobPage(jobs=jobs, next=following)

    def count(self, statuses: Sequence[Status]) -> int:
        """Return how many jobs have one of these statuses."""
        return self.records.count(statuses, owner=self.owner)

    def cancel(self, id: str) -> Job:
        """Cancel a job: a queued one ends at once, a running one is `cancelling` until it has stopped.

        Raises
        ------
        NotAllowedNow
            The job has succeeded or failed.
        """
        attempt_id = self.stored(id).attempt_id
        after = self.records.update(
            id, lambda stored: lifecycle.cancel(stored, now=self.clock(), retention=self.settings.retention)
        )
        if after.job.status is Status.CANCELLED:
            self.queue.remove(attempt_id)
        return after.job

    def delete(self, id: str) -> None:
        """Remove a finished job with its record and files. Files that cannot be removed now are removed by the reconciler.

        A new job may reuse the id at once, so only files named by the record are removed here. The reconciler also removes the
        files of lost attempts.

        Raises
        ------
        NotAllowedNow
            The job is not finished.
        """
        stored = self.stored(id)
        if not stored.job.status.final:
            stopping = stored.job.status is Status.CANCELLING
            hint = "Delete it when it is cancelled." if stopping else "Cancel it first."
            raise NotAllowedNow(id, stored.job.status, wanted="deleted", hint=hint)
        self.records.delete(stored, at=self.clock())
        with suppress(StoreUnavailable):
            for attempt_id in {stored.inputs.split("/")[2], stored.attempt_id}:
                self.blobs.delete(f"jobs/{id}/{attempt_id}/")
            if not self.blobs.list(f"jobs/{id}/"):
                self.records.forget_deleted(id)

    def artifact(self, id: str, name: str) -> tuple[Artifact, Blob]:
        """Return the record of a result file, and the file, readable in ranges.

        Raises
        ------
        UnknownArtifact
            The job has no file of that name, or no files yet.
        """
        stored = self.stored(id)
        for each in stored.job.artifacts:
            if each.name == name and stored.prefix is not None:
                return each, self.blobs.get(f"{stored.prefix}{name}")
        raise UnknownArtifact(id, name, names=[each.name for each in stored.job.artifacts])

    def kept_inputs(self, id: str, file: Path) -> tuple[Job, Path]:
        """Copy or link a job's stored inputs to a local file, to submit them again; return job and file. Do not write to it.

        Raises
        ------
        NotAllowedNow
            The job only writes further files of another one, whose inputs must be used instead.
        """
        stored = self.stored(id)
        if stored.job.outputs_of is not None:
            hint = f"It holds further files of job {stored.job.outputs_of!r}: use that job."
            raise NotAllowedNow(id, stored.job.status, wanted="run with other options", hint=hint)
        try:
            self.blobs.fetch(stored.inputs, file)
        except FileNotFoundError:  # deleted between lookup and copy
            raise UnknownJob(id) from None
        return stored.job, file

    def log(self, id: str) -> str:
        """Return the log of the job's attempts so far."""
        self.stored(id)
        return "".join(f"{line}\n" for line in self.records.log(id))

    def events(self, id: str, *, after: str | None = None) -> list[Event]:
        """Return the job's events after a given one; None: the latest 256, or 16 of a finished job. `records.changes` signals new ones.

        The last event of a finished job is a `job` event with a final status; nothing follows it.

        Raises
        ------
        InvalidRequest
            `after` is not an event id.
        """
        if after is not None:
            check_event_id(after)
        self.stored(id)
        return self.records.events(id, after=after)

    def used(self) -> int:
        """Return the total bytes of all jobs."""
        return self.records.used()

    def ready(self) -> dict[str, str]:
        """Return `ok` or a sentence with the fault, for each of `redis`, `blobs` and `workers`."""
        found: dict[str, str] = {}
        for part, check in (("redis", self.records.ping), ("blobs", self.blobs.check)):
            try:
                check()
                found[part] = "ok"
            except StoreUnavailable as error:
                found[part] = str(error)
        if found["redis"] != "ok":  # another query would wait just as long
            return {**found, "workers": found["redis"]}
        try:
            workers = self.queue.workers()
            found["workers"] = "ok" if workers else "No worker is running; start one with `pliant work`."
        except StoreUnavailable as error:
            found["workers"] = str(error)
        return found

    def stored(self, id: str) -> Stored:
        """Return a job with the internal fields of the worker package."""
        if not is_id(id):
            raise UnknownJob(id[:80])
        stored = self.records.get(id)
        if self.owner is not None and stored.owner != self.owner:
            raise UnknownJob(id)
        return stored

    def create_copy(self, job: Job, submission: Submission, source: Stored, *, inputs: str, result: str | None) -> Job:
        """Store and queue a new job of the source's owner, with copies of the blobs `inputs` and, if given, `result`.

        Raises
        ------
        Conflict, QuotaExceeded, TooManyQueued
            See `submit`.
        UnknownJob
            The source was deleted meanwhile.
        """
        copies = {"inputs.npz": inputs} | ({} if result is None else {"result.npz": result})

        def copy(to: str) -> None:
            try:
                for name, key in copies.items():
                    self.blobs.copy(key, f"{folder_of(to)}{name}")
            except FileNotFoundError:
                self.blobs.delete(folder_of(to))
                raise

        try:
            size = sum(self.blobs.get(key).size for key in copies.values())
            return self._create(job, submission, copy, size=size, owner=source.owner, from_result=result is not None)[0]
        except FileNotFoundError:
            raise UnknownJob(source.job.id) from None

    def _create(
        self, job: Job, submission: Submission, put: Callable[[str], object], *, size: int, owner: str | None = None,
        from_result: bool = False,
    ) -> tuple[Job, bool]:  # fmt: skip
        """Store a new job and queue it; return it and True, or the job of a simultaneous equal request and False.

        `put` stores `size` bytes: the inputs under the given blob key and, with `from_result`, the stored result beside them.
        `owner` defaults to the owner of these jobs.
        """
        attempt_id = new_attempt_id(job.id)
        reserved = 0
        if self.settings.disk_quota > 0:
            reserved = expected_files(job.interpretation, job.options, further=from_result)
        stored = Stored(
            job=job,
            owner=owner if owner is not None else self.owner or "",
            attempt_id=attempt_id,
            inputs=(inputs := f"jobs/{job.id}/{attempt_id}/inputs.npz"),
            result=f"{folder_of(inputs)}result.npz" if from_result else None,
            bytes=size + reserved,
            reserved=reserved,
            key=key_digest(submission.idempotency_key, self.owner),
            fingerprint=submission.fingerprint,
            webhook=submission.webhook,
            trace=tracing.traceparent(),
            max_running=self.max_running,
        )
        kept = accept(self, stored, put)
        new = kept.inputs == stored.inputs
        return self._placed(kept) if new else self._same(kept, submission, wanted=job.id), new

    def _same(self, found: Stored, submission: Submission, *, wanted: str | None = None) -> Job:
        """Return the job of a repeated request; raise `Conflict` for a different one."""
        mine = self.owner is None or found.owner == self.owner
        mine = mine and submission.id in (None, found.job.id)  # a key may stand for a job of another id
        if mine and submission.fingerprint is not None and found.fingerprint == submission.fingerprint:
            return self._placed(found)
        wanted = wanted or submission.id
        if found.job.id == wanted:
            raise Taken(
                "id_taken", id=wanted, field="id", expected="an id that no different job has", got=repr(wanted),
                sentence=f"The id {wanted!r} is already used by a different job.", hint="Choose another id.",
            )  # fmt: skip
        raise Taken(
            "idempotency_conflict", id=found.job.id, field="Idempotency-Key", expected="a key that no different request has",
            got=f"the key of the request that created job {found.job.id!r}",
            sentence=f"This Idempotency-Key was used for a different request, which created job {found.job.id!r}.", hint="Use a new key.",
        )  # fmt: skip

    def _placed(self, stored: Stored) -> Job:
        if stored.job.status is not Status.QUEUED:
            return stored.job
        try:
            place = self.queue.place(stored.attempt_id)
            if place is None and stored.attempt_id not in self.queue.held():
                place = 0  # a worker has just taken it
        except StoreUnavailable:
            return stored.job
        return stored.job.model_copy(update={"place_in_queue": place})

"""How jobs come in: a submission, a repeated one, one run again; each refused, or kept for good."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from pliant.schemas.job import Interpretation, Job, Status
from pliant.schemas.options import Options
from pliant.worker.errors import Conflict, NotAllowedNow, QuotaExceeded, StoreUnavailable, TooManyQueued, UnknownJob
from pliant.worker.jobs.validation import check_id, check_key, is_id
from pliant.worker.records import Records, Stored, Webhook, new_token, utc_now
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.queue import Queue


@dataclass(frozen=True, slots=True, kw_only=True)
class Intake:
    """What `pliant.worker.jobs.service.Jobs` is made of, and its half that takes jobs in."""

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

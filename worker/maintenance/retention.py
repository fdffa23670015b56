"""Retention: remove expired jobs and uploads, and files that belong to no job or attempt."""

from __future__ import annotations

import logging
import shutil
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta

from pliant.schemas.job import LARGEST_PAGE
from pliant.worker.errors import NotAllowedNow, UnknownJob
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import milliseconds
from pliant.worker.uploads.shared import open_uploads

logger = logging.getLogger(__name__)

CLEAN_EVERY = 30.0
"""Seconds between two checks for expired jobs and uploads."""

SWEEP_EVERY = 3600.0
"""Seconds between two checks for files that belong to no job, and for expired ones among all jobs."""

ORPHAN_AGE = timedelta(hours=6)
"""Age above which a file of an unknown job is removed; a younger one may belong to a submission without a record yet."""

DEAD_AGE = timedelta(minutes=1)
"""Age above which scratch directories of ended attempts are removed; their worker may still read younger ones."""

JUMP = 60.0
"""Seconds by which wall clock and monotonic clock must diverge between two checks to count as a jump."""

HOLD = 3600.0
"""Seconds without expiry after a clock jump: wrong clocks are usually corrected soon, and deletions cannot be undone."""


@dataclass(slots=True, kw_only=True)
class Retention:
    """Removes expired jobs, uploads and stray files."""

    jobs: Jobs
    _ahead: float | None = None
    """Wall clock minus monotonic clock, seconds."""
    _held_until: float | None = None
    _tidied: float | None = None
    _swept: float | None = None

    def tick(self, now: float) -> bool:
        """Run the tasks that are due at monotonic time `now`; return True if expired jobs and uploads were checked.

        Raises
        ------
        StoreUnavailable
            A store does not answer; nothing is lost, and the tasks stay due.
        """
        self._check_clock(now)
        tidied = self._tidied is None or now >= self._tidied + CLEAN_EVERY
        sweeps = self._swept is None or now >= self._swept + SWEEP_EVERY
        if tidied or sweeps:
            if self._held_until is None or now >= self._held_until:
                self._expire(among_all=sweeps)
                self._expire_uploads()
            self._clear_work()
            self._remove_deleted()
            self.jobs.queue.clean_up()
            self._tidied = now
        if sweeps:
            self._sweep()
            self._swept = now
        return tidied or sweeps

    def _check_clock(self, now: float) -> None:
        """Suspend expiry for a while if the wall clock, on which it depends, has jumped."""
        ahead = self.jobs.clock().timestamp() - now
        if self._ahead is not None and abs(ahead - self._ahead) > JUMP:
            self._held_until = now + HOLD
            logger.warning("the clock jumped by %.0f s; nothing expires for %.0f s", ahead - self._ahead, HOLD)
        self._ahead = ahead

    def _expire(self, *, among_all: bool = True) -> None:
        """Remove the jobs that have expired. A job that is not finished, or has no `expires_at`, is never touched.

        Unless `among_all`, only jobs that are older than the retention period are read. Others can have expired only if the period was
        shorter when they ended. Reading 10,000 records takes 4.5 s of processor time.
        """
        now, cursor = self.jobs.clock(), None
        if not among_all:
            if self.jobs.settings.retention == 0:
                return  # a job that expires has ended under an earlier setting
            oldest_kept = now - timedelta(seconds=self.jobs.settings.retention)
            cursor = f"{milliseconds(oldest_kept):014d}:000"  # before the first of those that were created then
        while True:
            page = self.jobs.page(cursor=cursor, limit=LARGEST_PAGE, statuses=lifecycle.FINAL)
            for job in page.jobs:
                if job.expires_at is not None and job.expires_at <= now:
                    # A client may have deleted it meanwhile and submitted another one under its id.
                    with suppress(UnknownJob, NotAllowedNow):
                        if self.jobs.get(job.id).created_at != job.created_at:
                            continue
                        self.jobs.delete(job.id)
                        logger.info("job %s: expired and removed", job.id, extra={"job": job.id})
            cursor = page.next
            if cursor is None:
                return

    def _expire_uploads(self) -> None:
        """Remove uploads that were neither continued nor used within the retention period."""
        for id in open_uploads(self.jobs.settings, self.jobs.blobs).expire(self.jobs.clock()):
            logger.info("upload %s: expired and removed", id)

    def _remove_deleted(self) -> None:
        """Remove the files of deleted jobs that the blob store failed to remove."""
        for id, deleted_at in self.jobs.records.deleted().items():
            for key, written in self.jobs.blobs.list(f"jobs/{id}/"):
                if written <= deleted_at and not is_wanted(self.jobs, key):
                    self.jobs.blobs.delete(key)
            self.jobs.records.forget_deleted(id)

    def _sweep(self) -> None:
        """Remove files that belong to no job or attempt: from submissions without a record and from killed attempts.

        A submission without a record has no results. Those of an unknown job are of lost records, or of another installation.
        """
        oldest = self.jobs.clock() - ORPHAN_AGE
        self.jobs.blobs.clear_unfinished(before=oldest)
        files = self.jobs.blobs.list("jobs/")
        with_results = {key.split("/")[1] for key, _ in files if "/artifacts/" in key}
        kept = set()
        for key, written in files:
            id, wanted = key.split("/")[1], is_wanted(self.jobs, key)
            if wanted is None and id in with_results:
                kept.add(id)
            elif wanted is False or (wanted is None and written < oldest):
                self.jobs.blobs.delete(key)
                logger.info("removed %s, which belongs to no job or attempt", key)
        if kept:
            logger.warning(
                "the files of %d job(s) with results but without a record are kept, for example %s; check that PLIANT_REDIS_URL, "
                "PLIANT_QUEUE and PLIANT_BLOB_URL are of one installation",
                len(kept),
                min(kept),
            )

    def _clear_work(self) -> None:
        """Remove scratch directories of ended attempts whose worker was killed before it removed them."""
        work, oldest = self.jobs.settings.work, self.jobs.clock() - DEAD_AGE
        for directory in work.iterdir() if work.exists() else ():
            with suppress(FileNotFoundError):
                if directory.stat().st_mtime < oldest.timestamp() and not self._is_running(directory.name):
                    shutil.rmtree(directory, ignore_errors=True)

    def _is_running(self, attempt_id: str) -> bool:
        return self.jobs.records.look(attempt_id.rpartition("-")[0], attempt_id) in lifecycle.ACTIVE


def is_wanted(jobs: Jobs, key: str) -> bool | None:
    """Return whether a job needs a file; None if the job does not exist (yet)."""
    try:
        held = jobs.records.get(key.split("/")[1])
    except UnknownJob:
        return None
    running = held.job.status in lifecycle.ACTIVE and f"/{held.attempt_id}/" in key
    published = held.prefix is not None and key.startswith(held.prefix)
    return key in (held.inputs, held.result) or running or published

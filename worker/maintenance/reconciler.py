"""The keeper: gives lost jobs to another worker, queues forgotten ones again, removes what has expired.

Any number of keepers may run; every change is a compare-and-set, so the second one to act finds nothing to do.

A running job is lost when its count of signs of life stood still for `Settings.lost_after` seconds *of watching*:
the keeper adds up the time between two looks that both succeeded, each gap counted as at most twice its usual length. So
neither a clock that jumps, nor a store that is away for minutes, nor a machine that slept makes a job look lost.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial

from pliant.schemas.job import Status
from pliant.worker.errors import StaleAttempt, StoreUnavailable, UnknownJob
from pliant.worker.execution.failures import worker_lost
from pliant.worker.execution.workdir import clean_up
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.validation import LARGEST_PAGE
from pliant.worker.records import Beat, new_token
from pliant.worker.uploads.service import Uploads

logger = logging.getLogger(__name__)

LOOK_EVERY = 1.0
"""Seconds between two looks at the running and queued jobs."""

TIDY_EVERY = 30.0
"""Seconds between two looks for what has expired."""

SWEEP_EVERY = 3600.0
"""Seconds between two looks for files that belong to no job."""

FORGOTTEN_AFTER = 3.0
"""Seconds of watching after which a queued job that the queue does not hold is queued again."""

ORPHAN_AGE = timedelta(hours=6)
"""A file of a job that is not known is removed when it is older: younger ones may be a submission that has no record yet."""

DEAD_AGE = timedelta(minutes=1)
"""Working files of an attempt that is over are removed when they are older: until then its worker may be reading them."""


JUMP = 60.0
"""Seconds by which the wall clock and the running time must part for it to be a jump."""

HOLD = 3600.0
"""Seconds after a jump of the clock in which nothing expires: a wrong clock is mostly put right soon, a deletion never."""


@dataclass(slots=True)
class Stillness:
    """For how long each thing has not changed, by our own watch."""

    _seen: dict[str, tuple[object, float]] = field(default_factory=dict)

    def look(self, things: dict[str, object], gap: float) -> dict[str, float]:
        """Take a look, `gap` seconds after the one before; return each thing's seconds without a change."""
        still: dict[str, tuple[object, float]] = {}
        for name, value in things.items():
            before, seconds = self._seen.get(name, (None, 0.0))
            still[name] = (value, seconds + gap if before == value and name in self._seen else 0.0)
        self._seen = still
        return {name: seconds for name, (_, seconds) in still.items()}


@dataclass(slots=True, kw_only=True)
class Keeper:
    """Looks after the jobs of one installation."""

    jobs: Jobs
    clock: Callable[[], float] = time.monotonic
    _running: Stillness = field(default_factory=Stillness)
    _queued: Stillness = field(default_factory=Stillness)
    _looked: float | None = None
    _ahead: float | None = None
    """Seconds that the wall clock is ahead of the running time."""
    _held_until: float | None = None
    _tidied: float | None = None
    _swept: float | None = None
    _cleaned: set[str] = field(default_factory=set)
    _ended: int | None = None
    """How many jobs had failed or been cancelled when we last cleaned up after them."""

    def tick(self) -> None:
        """Do what is due.

        Raises
        ------
        StoreUnavailable
            The store does not answer; what was due stays due.
        """
        now = self.clock()
        gap = 0.0 if self._looked is None else min(now - self._looked, 2 * LOOK_EVERY)
        self._looked = now
        self._mind_the_clock(now)
        self._take_from_lost_workers(gap)
        self._queue_forgotten(gap)
        self._clean_up_after_failures()
        if self._tidied is None or now >= self._tidied + TIDY_EVERY:
            if self._held_until is None or now >= self._held_until:
                self._expire()
                self._expire_uploads()
            self._clear_work()
            self._ended = None  # one may have expired while another failed: look again whatever the number
            self.jobs.queue.tidy()
            self._tidied = now
        if self._swept is None or now >= self._swept + SWEEP_EVERY:
            self._sweep()
            self._swept = now

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Tick until told to stop; a store that does not answer is waited for."""
        while not should_stop():
            try:
                self.tick()
            except StoreUnavailable as error:
                logger.warning("%s", error)
            time.sleep(LOOK_EVERY)

    def _take_from_lost_workers(self, gap: float) -> None:
        records, settings = self.jobs.records, self.jobs.settings
        beats = records.beats([*records.ids(Status.RUNNING), *records.ids(Status.CANCELLING)])
        for id, still in self._running.look(dict(beats), gap).items():
            if still < settings.lost_after:
                continue
            beat: Beat = beats[id]
            fresh = new_token(id)
            change = partial(
                lifecycle.requeue,
                token=beat.token,
                fresh=fresh,
                problem=worker_lost("The worker that had the job gave no sign of life any more."),
                now=self.jobs.clock(),
                max_attempts=settings.max_attempts,
                retention=settings.retention,
            )
            with suppress(StaleAttempt, UnknownJob):
                after = records.update(id, change)
                clean_up(settings, beat.token)
                self._say(id, f"Lost its worker; it is {after.job.status.value} now.")
                if after.job.status is Status.QUEUED:
                    self.jobs.queue.push(id, fresh, front=True)  # it has waited before
                self._remove_unwanted(id)

    def _queue_forgotten(self, gap: float) -> None:
        """Queue what the queue has lost, and what was held back until fewer of its owner's jobs run.

        The queue's own notes tell the two apart: what we saw at our last look would not do, since a job may be held back,
        and its place become free, between two looks.
        """
        records, queue = self.jobs.records, self.jobs.queue
        noted = queue.held()  # read first: a note is written after its record, so one without a record has had its time
        queued = records.beats(records.ids(Status.QUEUED))
        for token in noted - {beat.token for beat in queued.values()}:
            queue.let_go(token)
        waiting = set(queue.waiting())
        absent = {id: beat for id, beat in queued.items() if beat.token not in waiting}
        held = self._over_the_limit(queued, absent)
        for id in held:
            if absent[id].token not in noted:
                queue.hold(absent[id].token)
        free = {id: beat.token for id, beat in absent.items() if id not in held}
        for id, token in free.items():
            if token in noted:
                self._queue_again(id, token, front=False)
        lost = {id: token for id, token in free.items() if token not in noted}
        for id, still in self._queued.look(dict(lost), gap).items():
            if still >= FORGOTTEN_AFTER and self._queue_again(id, lost[id], front=True):
                self._say(id, "The queue had forgotten it; queued again.")

    def _over_the_limit(self, queued: Mapping[str, Beat], absent: Mapping[str, Beat]) -> set[str]:
        """Return the queued jobs that must wait because their owner has no more running.

        What is in the queue, or on its way from there to a worker, counts as running; the places that are left go to the oldest.
        """
        usual = self.jobs.settings.max_running
        if usual == 0 and all(beat.max_running is None for beat in absent.values()):
            return set()
        records = self.jobs.records
        active = records.beats([*records.ids(Status.RUNNING), *records.ids(Status.CANCELLING)])
        taken = Counter(beat.owner for beat in active.values())
        taken.update(beat.owner for id, beat in queued.items() if id not in absent)
        held: set[str] = set()
        for id, beat in absent.items():  # oldest first, as `ids` gives them
            taken[beat.owner] += 1
            most = usual if beat.max_running is None else beat.max_running
            if 0 < most < taken[beat.owner]:
                held.add(id)
        return held

    def _queue_again(self, id: str, old: str, *, front: bool) -> bool:
        """Put a queued job into the queue under a new token; False if somebody else was quicker."""
        fresh = new_token(id)
        try:
            self.jobs.records.update(id, partial(lifecycle.redeliver, token=old, fresh=fresh))
        except (StaleAttempt, UnknownJob):
            return False
        self.jobs.queue.remove(old)
        self.jobs.queue.push(id, fresh, front=front)
        return True

    def _mind_the_clock(self, now: float) -> None:
        """Let nothing expire for a while if the wall clock has jumped: what expires is told by it, and by it alone."""
        ahead = self.jobs.clock().timestamp() - now
        if self._ahead is not None and abs(ahead - self._ahead) > JUMP:
            self._held_until = now + HOLD
            logger.warning("the clock jumped by %.0f s; nothing expires for %.0f s", ahead - self._ahead, HOLD)
        self._ahead = ahead

    def _expire(self) -> None:
        """Remove the jobs whose time is over. Nothing that is not finished, or has no `expires_at`, is ever touched."""
        now, cursor = self.jobs.clock(), None
        while True:
            page = self.jobs.page(cursor=cursor, limit=LARGEST_PAGE, statuses=lifecycle.FINAL)
            for job in page.jobs:
                if job.expires_at is not None and job.expires_at <= now:
                    with suppress(UnknownJob):
                        self.jobs.delete(job.id)
                        logger.info("job %s: expired and removed", job.id)
            cursor = page.next
            if cursor is None:
                return

    def _expire_uploads(self) -> None:
        """Remove uploads that nobody went on with, or that no job took, for longer than they are kept."""
        for id in Uploads.open(self.jobs.settings).expire(self.jobs.clock()):
            logger.info("upload %s: expired and removed", id)

    def _clean_up_after_failures(self) -> None:
        """Remove what attempts had uploaded when they were killed, once for each job that ended badly of late."""
        badly = (Status.FAILED, Status.CANCELLED)
        ended = self.jobs.count(badly)
        if ended == self._ended:
            return
        page = self.jobs.page(limit=LARGEST_PAGE, statuses=badly)
        for id in [job.id for job in page.jobs if job.id not in self._cleaned]:
            self._remove_unwanted(id)
        self._cleaned, self._ended = {job.id for job in page.jobs}, ended

    def _remove_unwanted(self, id: str) -> None:
        """Remove what a job's dead attempts have stored."""
        for key, _ in self.jobs.blobs.list(f"jobs/{id}/"):
            if self._wanted(key) is False:
                self.jobs.blobs.delete(key)

    def _sweep(self) -> None:
        """Remove files that belong to no job: of submissions that died before their record, of attempts that were killed."""
        oldest = self.jobs.clock() - ORPHAN_AGE
        for key, written in self.jobs.blobs.list("jobs/"):
            wanted = self._wanted(key)
            if wanted is False or (wanted is None and written < oldest):
                self.jobs.blobs.delete(key)
                logger.info("removed %s, which belongs to no job or attempt", key)

    def _clear_work(self) -> None:
        """Remove working files of attempts that are over and whose worker did not live to do it."""
        work, oldest = self.jobs.settings.work, self.jobs.clock() - DEAD_AGE
        for directory in work.iterdir() if work.exists() else ():
            with suppress(FileNotFoundError):
                if directory.stat().st_mtime < oldest.timestamp() and not self._running_here(directory.name):
                    shutil.rmtree(directory, ignore_errors=True)

    def _wanted(self, key: str) -> bool | None:
        """Tell whether a job wants a file; None: there is no such job, or not yet."""
        try:
            held = self.jobs.records.get(key.split("/")[1])
        except UnknownJob:
            return None
        running = held.job.status in lifecycle.ACTIVE and f"/{held.token}/" in key
        published = held.prefix is not None and key.startswith(held.prefix)
        return key == held.inputs or running or published

    def _running_here(self, token: str) -> bool:
        return self.jobs.records.look(token.rpartition("-")[0], token) in lifecycle.ACTIVE

    def _say(self, id: str, sentence: str) -> None:
        logger.warning("job %s: %s", id, sentence)
        self.jobs.records.append_log(id, [sentence])

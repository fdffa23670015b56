"""The reconciler: requeue jobs whose worker was lost, and queued jobs that are missing from the queue.

Any number of reconcilers may run: every change is a compare-and-set, so only the first one takes effect.

A running job is lost when its heartbeat count has not changed for `Settings.lost_after` seconds of observation. The observed
time is the sum of the intervals between successful reads, each counted as at most twice its usual length. Clock jumps, an
unreachable store and a suspended machine therefore do not make a job look lost.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

from pliant.schemas.job import LARGEST_PAGE, Status
from pliant.worker.errors import StaleAttempt, StoreUnavailable, UnknownJob
from pliant.worker.execution.failures import worker_lost
from pliant.worker.execution.workdir import clean_up
from pliant.worker.ids import new_attempt_id
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import RANKS, order_waiting
from pliant.worker.maintenance.retention import Retention, is_wanted
from pliant.worker.records import Heartbeat, dated
from pliant.worker.store.outage import Outage, warn

logger = logging.getLogger(__name__)

LOOK_EVERY = 1.0
"""Seconds between two checks of the running and queued jobs."""

FORGOTTEN_AFTER = 3.0
"""Seconds of observation after which a queued job that is missing from the queue is queued again."""


STALE_WRITES = 3600.0
"""Seconds for which the files of a requeued job are checked again, every `retention.CLEAN_EVERY` seconds: the lost worker may
return within this time and still store files until its next heartbeat fails."""


@dataclass(slots=True)
class IdleTimer:
    """Tracks how long each value has not changed, by the monotonic clock."""

    _seen: dict[str, tuple[object, float]] = field(default_factory=dict)

    def look(self, things: dict[str, object], gap: float) -> dict[str, float]:
        """Observe the values `gap` seconds after the previous call; return the seconds without a change for each."""
        still: dict[str, tuple[object, float]] = {}
        for name, value in things.items():
            before, seconds = self._seen.get(name, (None, 0.0))
            still[name] = (value, seconds + gap if before == value and name in self._seen else 0.0)
        self._seen = still
        return {name: seconds for name, (_, seconds) in still.items()}


@dataclass(slots=True, kw_only=True)
class Reconciler:
    """Reconciles the records, queue and files of one installation."""

    jobs: Jobs
    clock: Callable[[], float] = time.monotonic
    retention: Retention = field(init=False)
    _running: IdleTimer = field(default_factory=IdleTimer)
    _queued: IdleTimer = field(default_factory=IdleTimer)
    _looked: float | None = None
    _cleaned: set[str] = field(default_factory=set)
    _ended: int | None = None
    """Number of finished jobs when the files of their attempts were last removed."""
    _taken: dict[str, float] = field(default_factory=dict)
    """When each job was last requeued; its former worker may be alive and store files for a while."""

    def __post_init__(self) -> None:
        self.retention = Retention(jobs=self.jobs)

    def tick(self) -> None:
        """Run the tasks that are due.

        Raises
        ------
        StoreUnavailable
            The store does not answer; nothing is lost, and the tasks stay due.
        """
        now = self.clock()
        gap = 0.0 if self._looked is None else min(now - self._looked, 2 * LOOK_EVERY)
        self._looked = now
        self._take_from_lost_workers(gap)
        self._queue_forgotten(gap)
        self._clean_up_after_attempts(now)
        if self.retention.tick(now):
            self._ended = None  # expired and finished jobs may cancel out in the count

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Call `tick` every `LOOK_EVERY` seconds until `should_stop` returns True; an unavailable store is only logged."""
        outage = Outage(redis_url=self.jobs.settings.redis, tell=warn(logger))
        while not should_stop():
            try:
                self.tick()
            except StoreUnavailable as error:
                outage.failed(error)
            else:
                outage.answered()
            time.sleep(LOOK_EVERY)

    def _take_from_lost_workers(self, gap: float) -> None:
        records, settings = self.jobs.records, self.jobs.settings
        beats = records.beats(records.ids(Status.RUNNING, Status.CANCELLING))
        for id, still in self._running.look(dict(beats), gap).items():
            if still < settings.lost_after:
                continue
            beat: Heartbeat = beats[id]
            fresh = new_attempt_id(id)
            change = partial(
                lifecycle.requeue,
                attempt_id=beat.attempt_id,
                fresh=fresh,
                problem=worker_lost("The worker of the job sent no more heartbeats."),
                now=self.jobs.clock(),
                max_attempts=settings.max_attempts,
                retention=settings.retention,
            )
            with suppress(StaleAttempt, UnknownJob):
                after = records.update(id, change)
                clean_up(settings, beat.attempt_id)
                self._log(id, f"The worker was lost; the job is {after.job.status.value} now.")
                if after.job.status is Status.QUEUED:
                    self.jobs.queue.push(id, fresh, front=True)  # it has been queued before
                    order_waiting(records, self.jobs.queue, [beat.owner])
                self._taken[id] = self.clock()
                self._remove_unwanted(id)

    def _queue_forgotten(self, gap: float) -> None:
        """Queue the jobs that are missing from the queue, and those held back whose owner has capacity again.

        Marks in the queue distinguish the two. A comparison with the previous check could not, since a job may be held back and
        its owner regain capacity between two checks.
        """
        records, queue = self.jobs.records, self.jobs.queue
        noted = queue.held()  # read first: a mark is written after its record, so one without a record is stale
        queued = records.beats(records.ids(Status.QUEUED))
        for attempt_id in noted - {beat.attempt_id for beat in queued.values()}:
            queue.release(attempt_id)
        waiting = set(queue.waiting())
        absent = {id: beat for id, beat in queued.items() if beat.attempt_id not in waiting}
        held = self._over_the_limit(queued, absent)
        for id in held:
            if absent[id].attempt_id not in noted:
                queue.hold(absent[id].attempt_id)
        free = {id: beat.attempt_id for id, beat in absent.items() if id not in held}
        back = {id for id, attempt_id in free.items() if attempt_id in noted and self._queue_again(id, attempt_id)}
        lost = {id: attempt_id for id, attempt_id in free.items() if attempt_id not in noted}
        for id, still in self._queued.look(dict(lost), gap).items():
            if still >= FORGOTTEN_AFTER and self._queue_again(id, lost[id], front=True):
                self._log(id, "The job was missing from the queue; queued again.")
                back.add(id)
        if back:
            order_waiting(records, queue, {absent[id].owner for id in back})

    def _over_the_limit(self, queued: Mapping[str, Heartbeat], absent: Mapping[str, Heartbeat]) -> set[str]:
        """Return the queued jobs to hold back because their owner has reached the limit of running jobs.

        Jobs in the queue, or on their way to a worker, count as running; the remaining capacity goes to the oldest of the
        highest priority.
        """
        usual = self.jobs.settings.max_running
        if usual == 0 and all(beat.max_running is None for beat in absent.values()):
            return set()
        records = self.jobs.records
        active = records.beats(records.ids(Status.RUNNING, Status.CANCELLING))
        taken = Counter(beat.owner for beat in active.values())
        taken.update(beat.owner for id, beat in queued.items() if id not in absent)
        held: set[str] = set()
        # Those of equal priority stay in the order of `ids`, the oldest first.
        for id, beat in sorted(absent.items(), key=lambda each: RANKS[each[1].priority]):
            taken[beat.owner] += 1
            most = usual if beat.max_running is None else beat.max_running
            if 0 < most < taken[beat.owner]:
                held.add(id)
        return held

    def _queue_again(self, id: str, old: str, *, front: bool = False) -> bool:
        """Queue a job under a new attempt id; return False if another process did so first."""
        fresh = new_attempt_id(id)
        try:
            self.jobs.records.update(id, partial(lifecycle.redeliver, attempt_id=old, fresh=fresh))
        except (StaleAttempt, UnknownJob):
            return False
        self.jobs.queue.remove(old)
        self.jobs.queue.push(id, fresh, front=front)
        return True

    def _clean_up_after_attempts(self, now: float) -> None:
        """Remove the files of attempts that are not their job's result, once for each finished job."""
        self._taken = {id: since for id, since in self._taken.items() if now < since + STALE_WRITES}
        ended = self.jobs.count(lifecycle.FINAL)
        if ended == self._ended:
            return
        page = self.jobs.page(limit=LARGEST_PAGE, statuses=lifecycle.FINAL)
        untidy = [job.id for job in page.jobs if job.status is not Status.SUCCEEDED or job.attempt > 1]
        for id in {*untidy, *self._taken} - self._cleaned:
            self._remove_unwanted(id)
        self._cleaned, self._ended = set(untidy) - self._taken.keys(), ended

    def _remove_unwanted(self, id: str) -> None:
        """Remove the files of a job's ended attempts."""
        for key, _ in self.jobs.blobs.list(f"jobs/{id}/"):
            if is_wanted(self.jobs, key) is False:
                self.jobs.blobs.delete(key)

    def _log(self, id: str, sentence: str) -> None:
        logger.warning("job %s: %s", id, sentence, extra={"job": id})
        self.jobs.records.append_log(id, dated(sentence))

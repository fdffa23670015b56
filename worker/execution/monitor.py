"""Supervision of one attempt by its worker: heartbeats, reasons to kill it, and an outcome if the attempt recorded none."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from typing import TypeVar

from pliant.schemas.job import Problem, Status
from pliant.worker.errors import StaleAttempt, StoreUnavailable, TimedOut, UnknownJob
from pliant.worker.execution.failures import (
    how_it_ended,
    out_of_memory,
    problem_of,
    timed_out,
    was_foreign,
    was_unrecorded,
    worker_lost,
)
from pliant.worker.execution.workdir import output_tail
from pliant.worker.ids import new_attempt_id
from pliant.worker.jobs import lifecycle
from pliant.worker.processes.containment import OomKills
from pliant.worker.records import Records, Stored, dated
from pliant.worker.settings import Settings

logger = logging.getLogger(__name__)

JOB_HEARTBEAT_SECONDS = 1.0
"""Seconds between heartbeats; each also returns the job's status."""


Answer = TypeVar("Answer")


class RetryDeadline:
    """Retry calls to an unavailable store, with one time limit for all calls together."""

    def __init__(self, seconds: float) -> None:
        self._until = time.monotonic() + seconds

    def retry(self, call: Callable[[], Answer]) -> Answer:
        """Repeat a call until the store answers or the time limit is reached; call at least once.

        Raises
        ------
        StoreUnavailable
            The store did not answer.
        """
        while True:
            try:
                return call()
            except StoreUnavailable:
                if time.monotonic() > self._until:
                    raise
                time.sleep(0.5)


class Reason(StrEnum):
    """Why the worker ends an attempt."""

    CANCELLED = "cancelled"
    TIMED_OUT = "timed_out"
    STOPPING = "stopping"
    STALE = "stale"


@dataclass(slots=True)
class Watch:
    """The worker's view of the attempt that its job process runs."""

    settings: Settings
    records: Records
    id: str
    attempt_id: str
    worker: str
    """Name of the worker."""
    clock: Callable[[], float] = time.monotonic
    reason: Reason | None = None
    """Why the job process was killed; None if it was not."""
    stopping: bool = False
    """Whether the worker is shutting down; the service manager may then kill the job process as well."""
    began: float = field(init=False)
    kills: OomKills = field(init=False)
    _next_beat: float = field(init=False)
    _cancelled: float | None = None
    _own_limit: float | None = None
    """The job's option `time_limit`, 0 for none; None before it is read."""

    def __post_init__(self) -> None:
        self.began = self._next_beat = self.clock()
        self.kills = OomKills.now()

    def must_end(self, *, stop_by: float | None) -> Reason | None:
        """Write a heartbeat if one is due; return the reason to kill the job process now, or None.

        `stop_by` is the monotonic time until which the job may continue while the worker shuts down.
        """
        now = self.clock()
        self.stopping = stop_by is not None
        if now >= self._next_beat:
            self._next_beat = now + JOB_HEARTBEAT_SECONDS
            self._look(now)
        grace, limit = self.settings.cancel_grace, self.limit
        if self.reason is Reason.STALE:
            return self.reason
        if self._cancelled is not None and now >= self._cancelled + grace:
            self.reason = Reason.CANCELLED
        elif limit > 0 and now >= self.began + limit + grace:
            self.reason = Reason.TIMED_OUT
        elif stop_by is not None and now >= stop_by:
            self.reason = Reason.STOPPING
        return self.reason

    @property
    def limit(self) -> float:
        """Time limit of the attempt, seconds: the lower of the setting and the job's option; 0: no limit."""
        return min((each for each in (self.settings.time_limit, self._own_limit or 0.0) if each > 0), default=0.0)

    def _look(self, now: float) -> None:
        try:
            status = self.records.beat(self.id, self.attempt_id)
            if self._own_limit is None and status is not None:
                self._own_limit = self.records.get(self.id).job.options.time_limit or 0.0
        except UnknownJob:
            status = None
        except StoreUnavailable:
            return  # the job continues; it needs no store until it writes its result
        if status is None:
            self.reason = Reason.STALE
        elif status is Status.CANCELLING and self._cancelled is None:
            self._cancelled = now


def finalize(watch: Watch, *, status: int, peak: int, deadline: RetryDeadline) -> Stored | None:
    """Record the outcome of a job process that ended without recording one; otherwise change nothing.

    Returns the new record, or None if unchanged. Reason and last output of the job process are logged before the record becomes
    final, so the log of a finished job is complete. `status` is the wait status of `os.wait4`, `peak` the peak resident size, bytes.

    Raises
    ------
    StoreUnavailable
        The store does not answer.
    """
    change = _outcome(watch, status=status, peak=peak)
    sentence = f"Ended by the worker: {watch.reason}." if watch.reason is not None else how_it_ended(status)
    words = [*dated(sentence), *output_tail(watch.settings, watch.attempt_id)]

    def record_outcome() -> Stored:
        change(watch.records.get(watch.id))  # raises if the outcome is recorded already
        watch.records.append_log(watch.id, words)
        words.clear()
        return watch.records.update(watch.id, change)

    try:
        settled = deadline.retry(record_outcome)
    except (StaleAttempt, UnknownJob):
        return None
    logger.warning("job %s: %s", watch.id, sentence, extra={"job": watch.id})
    return settled


def _outcome(watch: Watch, *, status: int, peak: int) -> Callable[[Stored], Stored]:
    settings, attempt_id, now = watch.settings, watch.attempt_id, datetime.now(UTC)

    def change(stored: Stored) -> Stored:
        if stored.worker != watch.worker:  # a duplicate delivery must not end the original attempt
            raise StaleAttempt(watch.id)
        if watch.reason is Reason.CANCELLED:
            return lifecycle.stop(stored, attempt_id=attempt_id, now=now, retention=settings.retention)
        stopped = watch.reason is Reason.STOPPING or (watch.reason is None and watch.stopping and _was_killed(status))
        # A worker with another blob store fails no job: it ends, and its jobs wait for a worker with the right one.
        foreign = watch.reason is None and was_foreign(status)
        # An outage of the store is no fault of the job: it is repeated, as it is by the reconciler when the outage lasts longer.
        if stopped or foreign or (watch.reason is None and was_unrecorded(status)):
            return lifecycle.requeue(
                stored,
                attempt_id=attempt_id,
                fresh=new_attempt_id(watch.id),
                problem=worker_lost("The worker was shut down." if stopped else how_it_ended(status)),
                now=now,
                max_attempts=None if stopped or foreign else settings.max_attempts,
                retention=settings.retention,
            )
        if watch.reason is Reason.TIMED_OUT:
            own = watch.limit != settings.time_limit
            problem = problem_of(TimedOut(watch.limit)) if own else timed_out(settings.time_limit)
        else:
            problem = _death(watch, status=status, peak=peak)
        return lifecycle.fail(stored, attempt_id=attempt_id, problem=problem, now=now, retention=settings.retention)

    return change


def _death(watch: Watch, *, status: int, peak: int) -> Problem:
    """Return out_of_memory if the kernel counted an OOM kill or the peak is above 90 % of the limit, else worker_lost."""
    killed = _was_killed(status)
    limit = watch.settings.memory_limit
    if (killed and OomKills.now().since(watch.kills)) or (limit > 0 and peak > 0.9 * limit):
        return out_of_memory(limit)
    return worker_lost(how_it_ended(status))


def _was_killed(status: int) -> bool:
    return os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL

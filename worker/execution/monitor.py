"""Watching over one attempt from outside: signs of life, reasons to kill it, and the last word if it had none."""

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
from pliant.worker.execution.failures import how_it_ended, out_of_memory, problem_of, timed_out, worker_lost
from pliant.worker.execution.workdir import last_words
from pliant.worker.ids import new_attempt_id
from pliant.worker.jobs import lifecycle
from pliant.worker.processes.containment import OomKills
from pliant.worker.records import Records, Stored
from pliant.worker.settings import Settings

logger = logging.getLogger(__name__)

BEAT = 1.0
"""Seconds between signs of life; each also tells how the job stands."""


Answer = TypeVar("Answer")


class Patience:
    """How long one still waits for a store that does not answer: one span of time for all that is asked within it."""

    def __init__(self, seconds: float) -> None:
        self._until = time.monotonic() + seconds

    def ask(self, call: Callable[[], Answer]) -> Answer:
        """Repeat what is asked or told until the store answers or the time is over; try once at least.

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
    """Why an attempt is ended from outside."""

    CANCELLED = "cancelled"
    TIMED_OUT = "timed_out"
    STOPPING = "stopping"
    STALE = "stale"


@dataclass(slots=True)
class Watch:
    """What the worker knows of the attempt that its job process is at."""

    settings: Settings
    records: Records
    id: str
    attempt_id: str
    worker: str
    """Name of the worker that watches."""
    clock: Callable[[], float] = time.monotonic
    reason: Reason | None = None
    """Why it was killed, once it was."""
    stopping: bool = False
    """The worker is being shut down; whoever does that may kill the job process as well."""
    began: float = field(init=False)
    kills: OomKills = field(init=False)
    _next_beat: float = field(init=False)
    _cancelled: float | None = None
    _own_limit: float | None = None
    """The option `time_limit` of the job, 0 for none; None: not read yet."""

    def __post_init__(self) -> None:
        self.began = self._next_beat = self.clock()
        self.kills = OomKills.now()

    def must_end(self, *, stop_by: float | None) -> Reason | None:
        """Give a sign of life if one is due, and return why the job process must be killed now, or None.

        Parameters
        ----------
        stop_by : float or None
            Until when the worker's own shutdown lets the job go on.
        """
        now = self.clock()
        self.stopping = stop_by is not None
        if now >= self._next_beat:
            self._next_beat = now + BEAT
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
        """Seconds that the attempt may take: the lower one of the setting's and the job's own; 0: no limit."""
        return min((each for each in (self.settings.time_limit, self._own_limit or 0.0) if each > 0), default=0.0)

    def _look(self, now: float) -> None:
        try:
            status = self.records.beat(self.id, self.attempt_id)
            if self._own_limit is None and status is not None:
                self._own_limit = self.records.get(self.id).job.options.time_limit or 0.0
        except UnknownJob:
            status = None
        except StoreUnavailable:
            return  # the job goes on; it needs no store until it writes its result
        if status is None:
            self.reason = Reason.STALE
        elif status is Status.CANCELLING and self._cancelled is None:
            self._cancelled = now


def finalize(watch: Watch, *, status: int, peak: int, patience: Patience) -> Stored | None:
    """Write the record's last word for a job process that ended without one; one that spoke is left alone.

    Returns the record if there was something to write. The job's log has the reason and the end of the job process's own output
    before the record is final: whoever is told that a job has ended finds its log whole.

    Parameters
    ----------
    status : int
        As `os.wait4` returns it.
    peak : int
        The job process's largest resident size, bytes.
    patience : Patience
        With a store that does not answer.

    Raises
    ------
    StoreUnavailable
        The store does not answer.
    """
    change = _verdict(watch, status=status, peak=peak)
    sentence = f"Ended from outside: {watch.reason}." if watch.reason is not None else how_it_ended(status)
    words = [sentence, *last_words(watch.settings, watch.attempt_id)]

    def speak() -> Stored:
        change(watch.records.get(watch.id))  # raises where there is nothing to say
        watch.records.append_log(watch.id, words)
        words.clear()
        return watch.records.update(watch.id, change)

    try:
        settled = patience.ask(speak)
    except (StaleAttempt, UnknownJob):
        return None
    logger.warning("job %s: %s", watch.id, sentence)
    return settled


def _verdict(watch: Watch, *, status: int, peak: int) -> Callable[[Stored], Stored]:
    settings, attempt_id, now = watch.settings, watch.attempt_id, datetime.now(UTC)

    def change(stored: Stored) -> Stored:
        if stored.worker != watch.worker:  # a second delivery of one attempt must not end the first
            raise StaleAttempt(watch.id)
        if watch.reason is Reason.CANCELLED:
            return lifecycle.stop(stored, attempt_id=attempt_id, now=now, retention=settings.retention)
        if watch.reason is Reason.STOPPING or (watch.reason is None and watch.stopping and _was_killed(status)):
            problem = worker_lost("The worker was shut down.")
            fresh = new_attempt_id(watch.id)
            return lifecycle.requeue(
                stored,
                attempt_id=attempt_id,
                fresh=fresh,
                problem=problem,
                now=now,
                max_attempts=None,
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
    """Tell a death for want of memory from the others: by the kernel's counters, or by a limit that was nearly full."""
    killed = _was_killed(status)
    limit = watch.settings.memory_limit
    if (killed and OomKills.now().since(watch.kills)) or (limit > 0 and peak > 0.9 * limit):
        return out_of_memory(limit)
    return worker_lost(how_it_ended(status))


def _was_killed(status: int) -> bool:
    return os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL

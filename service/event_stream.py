"""Event streams of jobs: a single reader thread per process serves any number of followers and jobs.

The reader waits for the ids of changed jobs (`Records.changes`), reads the new events of jobs that are followed here, and passes
them to the followers. A thousand followers of one job cost one read per change, plus one every `READ_AGAIN` seconds.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any

from pliant.schemas.job import Job
from pliant.worker.errors import UnknownJob
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Changes, Event, Records
from starlette.concurrency import run_in_threadpool

KEPT = 256
"""Events of a job that are kept for slow followers."""

WAIT = 1.0
"""Seconds that the reader waits for a change before it checks whether it should stop."""

WOKEN_AT_ONCE = 25
"""Followers that are woken per iteration of the event loop. It serves other requests between iterations; otherwise they would
wait until the last of a thousand followers has been written to."""

READ_AGAIN = 10.0
"""Seconds between reads of every followed job, because notifications are lost while a connection is re-established."""


class Followers:
    """The clients of one process that follow jobs."""

    def __init__(self) -> None:
        self.closing = asyncio.Event()
        self._watchers: dict[str, _Watcher] = {}
        self._reader: _Reader | None = None

    @property
    def watched(self) -> int:
        """Number of jobs that are followed now."""
        return len(self._watchers)

    def close(self) -> None:
        """End all event streams, so that the server can stop."""
        self.closing.set()
        for watcher in self._watchers.values():
            watcher.wake()
        self._stop_reader()

    async def follow(
        self, jobs: Jobs, id: str, *, after: str | None = None, heartbeat: float = 15.0
    ) -> AsyncGenerator[Event | None]:
        """Yield a job's events after the event `after`, and None whenever `heartbeat` seconds pass without one, until its end.

        Raises
        ------
        UnknownJob
            There is no such job, or it was deleted meanwhile.
        InvalidRequest
            `after` is not the id of an event.
        """
        watcher = self._watchers.get(id)
        # A client that reads nothing keeps one alive that failed, or whose job ended and was replaced by another with its id.
        if watcher is None or watcher.failure is not None or watcher.ended:
            watcher = self._watchers[id] = _Watcher()
        watcher.listeners += 1
        try:
            self._start_reader(jobs.records)  # before the first read, so that no change falls between the two
            # Before its events, which then include the last.
            ended = (await run_in_threadpool(jobs.get, id)).status.final
            known = await run_in_threadpool(jobs.events, id, after=after)
            last = after or "0-0"
            while True:
                for event in known:
                    last = event.id
                    yield event
                    if is_final(event):
                        return
                if ended or self.closing.is_set():
                    return
                if watcher.failure is not None:
                    raise watcher.failure
                self._start_reader(jobs.records)  # it may have ended after a failure, just before this follower came
                if not watcher.newer(last):
                    if watcher.ended:
                        return  # the id `after` is that of no event yet
                    if not await watcher.changed(heartbeat):
                        yield None
                known = watcher.newer(last)
        finally:
            watcher.listeners -= 1
            if watcher.listeners == 0 and self._watchers.get(id) is watcher:
                del self._watchers[id]
            if not self._watchers:
                self._stop_reader()

    async def wait(self, jobs: Jobs, id: str, seconds: float) -> Job:
        """Return the job once its status is final, or after `seconds` as it is then."""
        job = await run_in_threadpool(jobs.get, id)
        if job.status.final or seconds <= 0:
            return job
        try:
            async with asyncio.timeout(seconds):
                async for _ in self.follow(jobs, id):
                    pass
        except TimeoutError:
            pass
        return await run_in_threadpool(jobs.get, id)

    def _start_reader(self, records: Records) -> None:
        if self._reader is None or not self._reader.is_alive():
            self._reader = _Reader(records, self._watchers, asyncio.get_running_loop())
            self._reader.start()

    def _stop_reader(self) -> None:
        if self._reader is not None:
            self._reader.ended.set()
            self._reader = None


class _Reader(threading.Thread):
    """The thread that waits for changes and reads events. It passes results to followers on the event loop."""

    def __init__(self, records: Records, watchers: dict[str, _Watcher], loop: asyncio.AbstractEventLoop) -> None:
        super().__init__(name="events", daemon=True)
        self.ended = threading.Event()
        self._records = records
        self._watchers = watchers
        self._loop = loop

    def run(self) -> None:
        """Read until no job is followed or the store does not answer."""
        try:
            changes = self._records.changes()
            try:
                self._follow(changes)
            finally:
                changes.close()
        except Exception as error:  # noqa: BLE001 - passed to every follower, which raises it in its own request
            for watcher in list(self._watchers.values()):
                self._hand_over(watcher.fail, error)

    def _follow(self, changes: Changes) -> None:
        due = 0.0
        while not self.ended.is_set():
            everything = time.monotonic() >= due
            changed = set() if everything else changes.next(WAIT)
            followed = dict(self._watchers)
            if everything:
                due, changed = time.monotonic() + READ_AGAIN, set(followed)
            for id in changed & followed.keys():
                self._read(id, followed[id])

    def _read(self, id: str, watcher: _Watcher) -> None:
        events = self._records.events(id, after=watcher.read_up_to)
        if events:
            watcher.read_up_to = events[-1].id
            self._hand_over(watcher.publish, events)
            return
        try:
            self._records.get(id)
        except UnknownJob as error:
            self._hand_over(watcher.fail, error)

    def _hand_over(self, call: Callable[[Any], None], what: object) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(call, what)


class _Watcher:
    """A job that is followed: its latest events, and the followers that wait for the next event."""

    def __init__(self) -> None:
        self.listeners = 0
        self.failure: Exception | None = None
        self.ended = False
        """Whether the job's last event was read."""
        self.read_up_to: str | None = None
        """The last event that the reader has read."""
        self._events: deque[Event] = deque(maxlen=KEPT)
        self._waiting: dict[asyncio.Future[None], None] = {}

    def publish(self, events: list[Event]) -> None:
        """Add events and wake the followers."""
        self._events.extend(events)
        self.ended = self.ended or any(map(is_final, events))
        self.wake()

    def fail(self, error: Exception) -> None:
        """End every follower with an error."""
        self.failure = error
        self.wake()

    def wake(self) -> None:
        """Wake the followers, `WOKEN_AT_ONCE` per iteration of the event loop."""
        waiting, self._waiting = self._waiting, {}
        self._wake_some(deque(waiting))

    def _wake_some(self, waiting: deque[asyncio.Future[None]]) -> None:
        for _ in range(min(WOKEN_AT_ONCE, len(waiting))):
            follower = waiting.popleft()
            if not follower.done():  # it may have timed out meanwhile
                follower.set_result(None)
        if waiting:
            asyncio.get_running_loop().call_soon(self._wake_some, waiting)

    def newer(self, last: str) -> list[Event]:
        """Return the kept events after the event `last`."""
        known, found = _order(last), []
        for event in reversed(self._events):
            if _order(event.id) <= known:
                break
            found.append(event)
        return found[::-1]

    async def changed(self, seconds: float) -> bool:
        """Wait for the next event; return False if none arrives within `seconds`."""
        follower: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting[follower] = None
        try:
            async with asyncio.timeout(seconds):
                await follower
        except TimeoutError:
            return False
        finally:
            self._waiting.pop(follower, None)
        return True


@lru_cache(maxsize=KEPT)
def is_final(event: Event) -> bool:
    """Return True if this is a job's last event."""
    return event.name == "job" and Job.model_validate_json(event.data).status.final


def _order(id: str) -> tuple[int, int]:
    milliseconds, _, count = id.partition("-")
    return int(milliseconds), int(count)

"""Following jobs: one watcher for a job however many clients follow it, so that a thousand listeners cost one look-up.

A blocking read for every listener would hold a thread each; the watcher asks twice or thrice a second instead, which is as
often as progress is written.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator

from pliant.schemas.job import Job
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Event
from starlette.concurrency import run_in_threadpool

KEPT = 256
"""Events a watcher holds for listeners that are slow."""


class Followers:
    """The watchers of one process.

    Attributes
    ----------
    pause : float
        Seconds between two looks at a job; grows by a hundredth of it for every further job that is watched.
    """

    def __init__(self, *, pause: float = 0.3) -> None:
        self.pause = pause
        self.closing = asyncio.Event()
        self._watchers: dict[str, _Watcher] = {}

    @property
    def watched(self) -> int:
        """How many jobs are followed now."""
        return len(self._watchers)

    def close(self) -> None:
        """End every following, so that the server can stop."""
        self.closing.set()
        for watcher in self._watchers.values():
            watcher.wake()

    async def follow(
        self, jobs: Jobs, id: str, *, after: str | None = None, heartbeat: float = 15.0
    ) -> AsyncGenerator[Event | None]:
        """Yield a job's events as they come, None when `heartbeat` seconds passed without one; ends at a final status.

        Parameters
        ----------
        jobs : Jobs
            The jobs as the one who asks may see them.
        id : str
            The job.
        after : str, optional
            The last event already known; None begins with all that are kept.
        heartbeat : float
            Seconds.

        Raises
        ------
        UnknownJob
            There is no such job, or it vanished meanwhile.
        InvalidRequest
            `after` is no event's id.
        """
        watcher = self._watchers.get(id)
        if watcher is None:
            watcher = self._watchers[id] = _Watcher()
        watcher.listeners += 1
        try:
            known = await run_in_threadpool(jobs.events, id, after=after, timeout=0)
            last = after or "0-0"
            if watcher.task is None:
                # It looks with the rights of the first listener's process, not his: every listener was checked above.
                watcher.task = asyncio.create_task(
                    self._watch(jobs, id, watcher, since=known[-1].id if known else last)
                )
            while True:
                for event in known:
                    last = event.id
                    yield event
                    if is_final(event):
                        return
                if self.closing.is_set():
                    return
                if watcher.failure is not None:
                    raise watcher.failure
                if not watcher.newer(last) and not await watcher.changed(heartbeat):
                    yield None
                known = watcher.newer(last)
        finally:
            watcher.listeners -= 1
            if watcher.listeners == 0:
                if watcher.task is not None:
                    watcher.task.cancel()
                if self._watchers.get(id) is watcher:
                    del self._watchers[id]

    async def wait(self, jobs: Jobs, id: str, seconds: float) -> Job:
        """Return the job once its status is final, or as it is after so many seconds."""
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

    async def _watch(self, jobs: Jobs, id: str, watcher: _Watcher, *, since: str) -> None:
        last = since
        try:
            while True:
                await asyncio.sleep(self.pause * (1 + self.watched / 100))
                found = await run_in_threadpool(jobs.events, id, after=last, timeout=0)
                if found:
                    last = found[-1].id
                    watcher.tell(found)
        except Exception as error:  # noqa: BLE001 - handed to every listener, who raises it in his own request
            watcher.failure = error
            watcher.wake()


class _Watcher:
    """One job that is followed: its latest events, and who waits for the next."""

    def __init__(self) -> None:
        self.listeners = 0
        self.task: asyncio.Task[None] | None = None
        self.failure: Exception | None = None
        self._events: deque[Event] = deque(maxlen=KEPT)
        self._next = asyncio.Event()

    def tell(self, events: list[Event]) -> None:
        """Add events and wake whoever waits."""
        self._events.extend(events)
        self.wake()

    def wake(self) -> None:
        """Wake whoever waits."""
        self._next.set()
        self._next = asyncio.Event()

    def newer(self, last: str) -> list[Event]:
        """Return the events after one."""
        return [event for event in self._events if _order(event.id) > _order(last)]

    async def changed(self, seconds: float) -> bool:
        """Wait for the next event; False if none came in this time."""
        try:
            async with asyncio.timeout(seconds):
                await self._next.wait()
        except TimeoutError:
            return False
        return True


def is_final(event: Event) -> bool:
    """Return True if nothing follows this event."""
    return event.name == "job" and Job.model_validate_json(event.data).status.final


def _order(id: str) -> tuple[int, int]:
    time, _, count = id.partition("-")
    return int(time), int(count)

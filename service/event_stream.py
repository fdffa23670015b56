"""Following jobs: one watcher per job, shared by all clients that follow it.

A blocking read per client would hold a thread each; the watcher polls the store about three times a second instead, as often as
progress is written.
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
"""Events that a watcher keeps for slow clients."""


class Followers:
    """The watchers of one process.

    Attributes
    ----------
    pause : float
        Seconds between two reads of a job's events; grows by one hundredth for every further job that is followed.
    """

    def __init__(self, *, pause: float = 0.3) -> None:
        self.pause = pause
        self.closing = asyncio.Event()
        self._watchers: dict[str, _Watcher] = {}

    @property
    def watched(self) -> int:
        """Number of jobs that are followed now."""
        return len(self._watchers)

    def close(self) -> None:
        """End all streams, so that the server can stop."""
        self.closing.set()
        for watcher in self._watchers.values():
            watcher.wake()

    async def follow(
        self, jobs: Jobs, id: str, *, after: str | None = None, heartbeat: float = 15.0
    ) -> AsyncGenerator[Event | None]:
        """Yield a job's events as they occur, None after `heartbeat` seconds without one; end at a final status.

        Parameters
        ----------
        jobs : Jobs
            The jobs that the client may see.
        id : str
            The job.
        after : str, optional
            The last event received; None starts with all events that are kept.
        heartbeat : float
            Seconds.

        Raises
        ------
        UnknownJob
            There is no such job, or it was deleted meanwhile.
        InvalidRequest
            `after` is not the id of an event.
        """
        watcher = self._watchers.get(id)
        if watcher is None:
            watcher = self._watchers[id] = _Watcher()
        watcher.listeners += 1
        try:
            job = await run_in_threadpool(jobs.get, id)
            known = await run_in_threadpool(jobs.events, id, after=after, timeout=0)
            last = after or "0-0"
            if job.status.final:  # no event follows those just read, even if the client has them all
                for event in known:
                    yield event
                return
            if watcher.task is None:
                # It reads with the rights of the first client; every client was authorized above.
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
        """Return the job once its status is final, or its state after `seconds`."""
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
                    watcher.publish(found)
        except Exception as error:  # noqa: BLE001 - raised again in the request of each client
            watcher.failure = error
            watcher.wake()


class _Watcher:
    """One job that is followed: its latest events, and a signal for the next."""

    def __init__(self) -> None:
        self.listeners = 0
        self.task: asyncio.Task[None] | None = None
        self.failure: Exception | None = None
        self._events: deque[Event] = deque(maxlen=KEPT)
        self._next = asyncio.Event()

    def publish(self, events: list[Event]) -> None:
        """Add events and wake all waiting clients."""
        self._events.extend(events)
        self.wake()

    def wake(self) -> None:
        """Wake all waiting clients."""
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
    """Return True if no event follows this one."""
    return event.name == "job" and Job.model_validate_json(event.data).status.final


def _order(id: str) -> tuple[int, int]:
    time, _, count = id.partition("-")
    return int(time), int(count)

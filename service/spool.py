"""The spool, a folder for request bodies while they arrive, and the slots in which they are parsed.

Each process owns one sub-folder and locks a file beside it; each request gets a scratch directory in it, removed when the
request ends. The next process that starts removes sub-folders of killed processes, recognized by their free lock.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import tempfile
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

import anyio
from anyio import to_thread

Answer = TypeVar("Answer")


class Incoming:
    """The sub-folder of one process in the spool, which exists between `open` and `close`.

    Attributes
    ----------
    directory : Path
        The folder shared by all processes of the service.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._own: Path | None = None
        self._lock = -1

    def open(self) -> None:
        """Create a sub-folder and remove those of processes that have ended."""
        self.directory.mkdir(parents=True, exist_ok=True)
        while self._own is None:
            name = secrets.token_hex(8)
            lock = self.directory / f"{name}.lock"
            descriptor = os.open(lock, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            # Another process may have removed the file just before it was locked.
            if os.fstat(descriptor).st_nlink == 0:
                os.close(descriptor)
                continue
            self._lock, self._own = descriptor, self.directory / name
            self._own.mkdir(mode=0o700)
        self._sweep()

    def close(self) -> None:
        """Remove the sub-folder."""
        if self._own is None:
            return
        shutil.rmtree(self._own, ignore_errors=True)
        self._own.with_suffix(".lock").unlink(missing_ok=True)
        os.close(self._lock)
        self._own, self._lock = None, -1

    @asynccontextmanager
    async def scratch(self) -> AsyncIterator[Path]:
        """Create an empty scratch directory, and remove it with its contents when the block ends, both on a thread."""
        assert self._own is not None, "open() comes first"
        path = await to_thread.run_sync(partial(tempfile.mkdtemp, dir=self._own, prefix=""))
        try:
            yield Path(path)
        finally:
            # Removal of gigabytes takes a while, in which the client may disconnect.
            with anyio.CancelScope(shield=True):
                await to_thread.run_sync(partial(shutil.rmtree, path, ignore_errors=True))

    def abandoned(self) -> list[str]:
        """Return the sub-folders of ended processes, which the next process that starts will remove."""
        found = []
        for lock in sorted(self.directory.glob("*.lock")):
            with suppress(FileNotFoundError, BlockingIOError), lock.open("rb") as held:
                fcntl.flock(held, fcntl.LOCK_SH | fcntl.LOCK_NB)
                found.append(lock.stem)
        return found

    def _sweep(self) -> None:
        """Remove the sub-folders of ended processes, whose lock is free."""
        for lock in self.directory.glob("*.lock"):
            try:
                descriptor = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
            except FileNotFoundError:  # its process has just ended normally
                continue
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(lock.with_suffix(""), ignore_errors=True)
                lock.unlink(missing_ok=True)
            except BlockingIOError:  # its process runs, perhaps this one
                pass
            finally:
                os.close(descriptor)


class ParserSlots:
    """Runs a limited number of calls at once on threads. A free slot goes to the waiting owner that holds the fewest.

    Parameters
    ----------
    total : int
        Maximum number of calls at once.
    """

    def __init__(self, total: int) -> None:
        self._free = total
        self._limiter = anyio.CapacityLimiter(total)
        self._held: Counter[str] = Counter()
        self._waiting: OrderedDict[str, deque[anyio.Event]] = OrderedDict()

    async def run(self, owner: str, call: Callable[[], Answer]) -> Answer:
        """Run a call once a slot is free for its owner, and return its result."""
        await self._take(owner)
        try:
            return await to_thread.run_sync(call, limiter=self._limiter)
        finally:
            self._give_back(owner)

    async def _take(self, owner: str) -> None:
        if self._free > 0:
            self._free -= 1
            self._held[owner] += 1
            return
        granted = anyio.Event()
        self._waiting.setdefault(owner, deque()).append(granted)
        try:
            await granted.wait()
        except BaseException:
            if granted.is_set():
                self._give_back(owner)
            else:
                self._leave(owner, granted)
            raise

    def _give_back(self, owner: str) -> None:
        self._held[owner] -= 1
        if not self._held[owner]:
            del self._held[owner]
        if not self._waiting:
            self._free += 1
            return
        following = min(self._waiting, key=lambda each: self._held[each])  # of equals the first in the queue
        granted = self._waiting[following][0]
        self._leave(following, granted)
        if following in self._waiting:
            self._waiting.move_to_end(following)
        self._held[following] += 1
        granted.set()

    def _leave(self, owner: str, granted: anyio.Event) -> None:
        self._waiting[owner].remove(granted)
        if not self._waiting[owner]:
            del self._waiting[owner]

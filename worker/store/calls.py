"""Limits on calls to stores that may hang, so that requests that do not need the store are still served."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

import redis
from pliant.worker.errors import StoreUnavailable

AT_ONCE = 12
"""Maximum number of concurrent calls to the blob store."""

WAITING = 12
"""Maximum number of waiting calls. Together with `AT_ONCE` it is below the 40 request threads of the service, so that requests that
do not need the blob store are served while it hangs."""

Answer = TypeVar("Answer")


class RemoteCalls:
    """Runs calls that may hang."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._waiting = 0

    def run(self, call: Callable[[], Answer], *, seconds: float) -> Answer:
        """Return the result of the call; its exceptions pass through.

        `seconds` includes the wait for a thread. The call itself may end later, at its own time limit.

        Raises
        ------
        StoreUnavailable
            The time limit is reached, or too many calls are waiting.
        """
        with self._lock:
            if self._waiting >= AT_ONCE + WAITING:
                raise StoreUnavailable("The blob store", reason="too many requests are waiting for it")
            self._waiting += 1
            if self._pool is None:
                self._pool = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="blobs")
        future = self._pool.submit(call)
        try:
            return future.result(timeout=seconds)
        except TimeoutError:
            future.cancel()
            raise StoreUnavailable("The blob store", reason=f"no answer within {seconds:g} s") from None
        finally:
            with self._lock:
                self._waiting -= 1


COMMANDS = 24
"""Maximum number of commands that wait for Redis at once, fewer than the 40 request threads of the service."""

TURN = 2.0
"""Maximum seconds that a command waits while `COMMANDS` others wait for the server."""

SILENT_AFTER = 2.0
"""Seconds without any answer, while a command is waiting for one, after which the server counts as silent."""

PROBES = 4
"""Maximum number of commands that wait for a silent server; further ones are rejected, except for one per second."""


LAST_LOOK = 0.05
"""Seconds that a command waits for an answer of a silent server before it is rejected. If this process itself was paused, as on an
overloaded machine, the answers have already arrived and only need to be read."""


@dataclass(slots=True)
class SilentServer:
    """Counts the commands that wait for one Redis server, and rejects further ones while it does not answer.

    Otherwise each request would wait for the full time limit, and requests that wait for a thread even longer.
    """

    clock: Callable[[], float] = time.monotonic
    _capacity: threading.Condition = field(default_factory=threading.Condition)
    _since: dict[object, float] = field(default_factory=dict)
    """When each waiting command was sent."""
    _answered: float = 0.0
    _silent: bool = False
    """Whether a command failed after more than `SILENT_AFTER` seconds, and none was answered since."""
    _probed: float = 0.0

    @contextmanager
    def call(self) -> Iterator[None]:
        """Count the command that is sent in this block.

        Raises
        ------
        redis.TimeoutError
            The command was not sent: the server is silent, or too many commands are waiting.
        """
        command = object()
        with self._capacity:
            self._wait_for_turn()
            self._since[command] = self._probed = self.clock()
        answered = True
        try:
            yield
        except (redis.ConnectionError, redis.TimeoutError):
            answered = False
            raise
        finally:
            with self._capacity:
                now, since = self.clock(), self._since.pop(command)
                if answered:
                    self._answered, self._silent = now, False
                elif now - since > SILENT_AFTER:
                    self._silent = True
                self._capacity.notify_all()

    def _wait_for_turn(self) -> None:
        until = self.clock() + TURN
        while len(self._since) >= COMMANDS and not self._is_silent():
            left = until - self.clock()
            if left <= 0:
                raise redis.TimeoutError("too many commands are waiting for the server")
            self._capacity.wait(left)
        if self._refuses():
            self._capacity.wait(LAST_LOOK)
            if self._refuses():
                raise redis.TimeoutError("the server does not answer")

    def _refuses(self) -> bool:
        return self._is_silent() and len(self._since) >= PROBES and self.clock() < self._probed + 1

    def _is_silent(self) -> bool:
        oldest = min(self._since.values(), default=self.clock())
        return self._silent or self.clock() - max(oldest, self._answered) > SILENT_AFTER

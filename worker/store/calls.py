"""Calls to a remote store: with a time limit, in a small thread pool, and rejected when too many are waiting."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from pliant.worker.errors import StoreUnavailable

AT_ONCE = 12
"""Maximum number of concurrent calls."""

WAITING = 12
"""Maximum number of waiting calls. With the concurrent ones they are fewer than the 40 request threads of the service, so that
requests that need no blob store are served while the store hangs."""

Answer = TypeVar("Answer")


class RemoteCalls:
    """Runs calls that may hang."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._waiting = 0

    def run(self, call: Callable[[], Answer], *, seconds: float) -> Answer:
        """Return the result of the call; its exceptions pass through.

        Parameters
        ----------
        seconds : float
            Time limit, including the wait for a thread. The call itself may end later, by its own time limit.

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

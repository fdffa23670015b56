"""Calls to a remote store: each with a time limit, on a small pool of threads, and refused at once when too many wait."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from pliant.worker.errors import StoreUnavailable

AT_ONCE = 12
"""Calls that are made at once."""

WAITING = 12
"""Further calls that may wait for one of them. Together they are fewer than the 40 threads of the service's requests, so that requests
which need no blob store find a thread while the store hangs."""

Answer = TypeVar("Answer")


class RemoteCalls:
    """Runs calls that may hang."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._waiting = 0

    def run(self, call: Callable[[], Answer], *, seconds: float) -> Answer:
        """Return what the call returns; its exceptions pass through.

        Parameters
        ----------
        seconds : float
            How long to wait for it, its wait for a thread included. The call itself ends later, by its own time limit.

        Raises
        ------
        StoreUnavailable
            It took longer, or too many calls wait.
        """
        with self._lock:
            if self._waiting >= AT_ONCE + WAITING:
                raise StoreUnavailable("The blob store", reason="too many requests wait for it")
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

"""Notifications of changed jobs: one subscription per process, however many jobs are followed.

Every write of a record publishes the job's id on one channel. Messages can be lost while a connection is re-established, so
followers also poll their job at longer intervals.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import redis
from pliant.worker.records import Changes
from pliant.worker.store.connection import reachable


def channel(prefix: str) -> str:
    """Return the channel on which the ids of changed jobs are published."""
    return f"{prefix}:changes"


class RedisChanges(Changes):
    """A subscription of one connection."""

    def __init__(self, client: redis.Redis, *, prefix: str) -> None:
        self._pubsub: Any = client.pubsub(ignore_subscribe_messages=True)  # type: ignore[no-untyped-call]
        with reachable():
            self._pubsub.subscribe(channel(prefix))

    def next(self, timeout: float) -> set[str]:
        found: set[str] = set()
        with reachable():
            until = time.monotonic() + timeout
            while not found and (left := until - time.monotonic()) > 0:
                message = self._pubsub.get_message(timeout=left)
                while message is not None:  # drain all messages that have arrived
                    found.add(message["data"])
                    message = self._pubsub.get_message(timeout=0)
        return found

    def close(self) -> None:
        self._pubsub.close()


class MemoryChanges(Changes):
    """A subscription within one process; the store calls `add`."""

    def __init__(self) -> None:
        self._arrived = threading.Condition()
        self._ids: set[str] = set()

    def add(self, id: str) -> None:
        """Add a changed job."""
        with self._arrived:
            self._ids.add(id)
            self._arrived.notify_all()

    def next(self, timeout: float) -> set[str]:
        with self._arrived:
            self._arrived.wait_for(lambda: bool(self._ids), timeout)
            found, self._ids = self._ids, set()
            return found

    def close(self) -> None:
        """See `Changes.close`."""

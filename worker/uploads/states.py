"""State of uploads that several API processes share: one JSON text per upload in a Redis hash, written by compare-and-set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import Any

import redis
from pliant.worker.errors import JOB_STORE, StoreUnavailable
from pliant.worker.store.connection import connect, reachable
from pydantic import BaseModel, ConfigDict

RESERVED_FOR = 120.0
"""Seconds after which a quota reservation without new bytes lapses, because its writer may have been killed."""

COUNTING_WITHIN = 10.0
"""Seconds that one process may take to count and reserve space."""

# KEYS: 1 the hash; ARGV: 1 field, 2 text before ('': none), 3 text after ('': none). A repetition after a lost reply succeeds, too.
_SWAP = """
local held = redis.call('HGET', KEYS[1], ARGV[1]) or ''
if held == ARGV[3] then return 1 end
if held ~= ARGV[2] then return 0 end
if ARGV[3] == '' then redis.call('HDEL', KEYS[1], ARGV[1]) else redis.call('HSET', KEYS[1], ARGV[1], ARGV[3]) end
return 1
"""


class State(BaseModel):
    """State of one upload."""

    model_config = ConfigDict(frozen=True)

    generation: str
    """Part of the blob keys of its pieces; restarting an upload begins a new generation."""
    writer: str
    """The request that may append; a newer request changes it."""
    pieces: tuple[tuple[str, int], ...] = ()
    """Key within the generation, and size in bytes, of each stored piece."""
    length: int | None = None
    """Bytes of the complete upload, if known."""
    sha256: str | None = None
    """SHA-256 of the complete upload; None until it is complete."""
    touched: float
    """Time of the last byte or use, seconds since 1970."""
    reserved: int = 0
    """Bytes of the quota that are reserved while it is written."""

    @property
    def offset(self) -> int:
        """Number of stored bytes."""
        return sum(size for _, size in self.pieces)

    def taken(self, now: float) -> int:
        """Return the bytes of the quota that the upload uses at time `now`, seconds since 1970."""
        return max(self.offset, self.reserved if now < self.touched + RESERVED_FOR else 0)


class UploadStates:
    """The states of one installation. Every method may raise `StoreUnavailable`."""

    def __init__(self, client: redis.Redis, *, queue: str) -> None:
        self._redis: Any = client
        self._key = f"{queue}:uploads"
        self._swap = client.register_script(_SWAP)

    def get(self, name: str) -> State | None:
        """Return the state of an upload, None if there is none."""
        with reachable():
            text = self._redis.hget(self._key, name)
        return None if text is None else State.model_validate_json(text)

    def all(self) -> dict[str, State]:
        """Return all states by name."""
        with reachable():
            found = self._redis.hgetall(self._key)
        return {name: State.model_validate_json(text) for name, text in found.items()}

    def names(self) -> list[str]:
        """Return the names of all uploads."""
        with reachable():
            return list(self._redis.hkeys(self._key))

    def swap(self, name: str, before: State | None, after: State | None) -> bool:
        """Replace a state if it is still `before`; return whether it was replaced. None stands for no upload."""
        texts = ["" if each is None else each.model_dump_json() for each in (before, after)]
        with reachable():
            return bool(self._swap(keys=[self._key], args=[name, *texts]))

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Hold the lock for counting and reserving space, so that two uploads cannot reserve the same bytes."""
        lock = self._redis.lock(f"{self._key}:counting", timeout=COUNTING_WITHIN, blocking_timeout=COUNTING_WITHIN)
        with reachable():
            held = lock.acquire()
        if not held:
            raise StoreUnavailable(JOB_STORE, reason="the space for uploads is being counted")
        try:
            yield
        finally:
            with reachable(), suppress(redis.exceptions.LockError):  # it expired
                lock.release()


@lru_cache(maxsize=8)
def open_states(redis_url: str, queue: str) -> UploadStates:
    """Return the states of an installation; the result is cached, so that all callers share its connections."""
    return UploadStates(connect(redis_url, decode=True), queue=queue)

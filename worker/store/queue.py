"""The queue: RQ carries an attempt's attempt_id from the one who submits to the one who works; it knows nothing else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import redis
from pliant.worker.store.connection import reachable
from rq import Queue as RqQueue
from rq import worker_registration
from rq.exceptions import InvalidJobOperation, NoSuchJobError
from rq.job import Job as RqJob
from rq.registry import clean_registries
from rq.serializers import JSONSerializer

FUNCTION = "pliant.worker.execution.attempt.run"
"""The only function a delivery may name."""

# KEYS: 1 the list; ARGV: attempt, rank, attempt, rank, …
_ORDER = """
local rank, places, found = {}, {}, {}
for i = 1, #ARGV, 2 do rank[ARGV[i]] = tonumber(ARGV[i + 1]) end
for place, attempt in ipairs(redis.call('LRANGE', KEYS[1], 0, -1)) do
  if rank[attempt] then
    places[#places + 1] = place - 1
    found[#found + 1] = {attempt, rank[attempt], place}
  end
end
table.sort(found, function(a, b) if a[2] ~= b[2] then return a[2] < b[2] end return a[3] < b[3] end)
for i, each in ipairs(found) do redis.call('LSET', KEYS[1], places[i], each[1]) end
"""

FAILURE_KEPT = 60
"""Seconds RQ keeps its own note of a delivery that died; ours is the job record."""


def alive_key(queue: str, worker: str) -> str:
    """Return the key that lives only as long as its worker does (RQ's own entry outlives a killed worker by minutes)."""
    return f"{queue}:worker:{worker}"


class Queue(ABC):
    """Who is next."""

    @abstractmethod
    def push(self, id: str, attempt_id: str, *, front: bool = False) -> None:
        """Put an attempt at the end, or before all the others; nothing happens if it waits already."""

    @abstractmethod
    def remove(self, attempt_id: str) -> None:
        """Take an attempt out, whether it waits or is held back."""

    @abstractmethod
    def hold(self, attempt_id: str) -> None:
        """Note that an attempt is kept out on purpose, until fewer of its owner's jobs run."""

    @abstractmethod
    def held(self) -> set[str]:
        """Return the attempt_ids that are noted as held back."""

    @abstractmethod
    def let_go(self, attempt_id: str) -> None:
        """Strike the note that an attempt is held back; nothing else happens to it."""

    @abstractmethod
    def waiting(self) -> list[str]:
        """Return the attempt_ids of all attempts that wait, next first."""

    @abstractmethod
    def place(self, attempt_id: str) -> int | None:
        """Return how many attempts wait before this one, None if it does not wait."""

    @abstractmethod
    def order(self, ranks: Mapping[str, int]) -> None:
        """Order these attempts by rank, smaller first and else as they are, on the places that they hold together."""

    @abstractmethod
    def tidy(self) -> None:
        """Remove what dead workers left behind in the queue's own books."""

    @abstractmethod
    def workers(self) -> list[str]:
        """Return the names of the workers that have shown signs of life lately."""

    @abstractmethod
    def memories(self) -> dict[str, int]:
        """Return the bytes that a job may take on each of these workers, by name; those that state none are left out."""


class RedisQueue(Queue):
    """RQ on Redis, JSON only. One queue, so that RQ moves ids by BLMOVE and cannot drop one between two hands."""

    def __init__(self, client: redis.Redis, *, name: str) -> None:
        self._redis: Any = client
        self._name = name
        self._held = f"{name}:held"
        self._order = client.register_script(_ORDER)
        self._queue = RqQueue(name, connection=client, serializer=JSONSerializer)

    def push(self, id: str, attempt_id: str, *, front: bool = False) -> None:
        """See `Queue.push`."""
        with reachable():
            if self._redis.lpos(self._queue.key, attempt_id) is not None:
                return
            self._queue.enqueue_call(
                FUNCTION,
                args=(id, attempt_id),
                job_id=attempt_id,
                timeout=-1,  # ours is kept by the worker, who can end a C call; RQ's alarm cannot
                result_ttl=0,
                failure_ttl=FAILURE_KEPT,
                description=f"job {id}",
                at_front=front,
            )

    def remove(self, attempt_id: str) -> None:
        """See `Queue.remove`."""
        self.let_go(attempt_id)
        with reachable():
            for key in (self._queue.key, self._queue.intermediate_queue_key):
                self._redis.lrem(key, 0, attempt_id)
            try:
                RqJob.fetch(attempt_id, connection=self._redis, serializer=JSONSerializer).delete()
            except (NoSuchJobError, InvalidJobOperation):  # gone already, or just now
                return
            except ValueError:  # the worker that took it strikes its note of that just now; RQ stumbles over the gap
                self._redis.delete(RqJob.key_for(attempt_id))

    def hold(self, attempt_id: str) -> None:
        """See `Queue.hold`."""
        with reachable():
            self._redis.sadd(self._held, attempt_id)

    def held(self) -> set[str]:
        """See `Queue.held`."""
        with reachable():
            return {attempt_id.decode() for attempt_id in self._redis.smembers(self._held)}

    def let_go(self, attempt_id: str) -> None:
        """See `Queue.let_go`."""
        with reachable():
            self._redis.srem(self._held, attempt_id)

    def waiting(self) -> list[str]:
        """See `Queue.waiting`."""
        with reachable():
            return [attempt_id.decode() for attempt_id in self._redis.lrange(self._queue.key, 0, -1)]

    def place(self, attempt_id: str) -> int | None:
        """See `Queue.place`."""
        with reachable():
            place: int | None = self._redis.lpos(self._queue.key, attempt_id)
        return place

    def order(self, ranks: Mapping[str, int]) -> None:
        """See `Queue.order`."""
        with reachable():
            self._order(keys=[self._queue.key], args=[part for each in ranks.items() for part in each])

    def tidy(self) -> None:
        """See `Queue.tidy`."""
        with reachable():
            if not self._queue.acquire_maintenance_lock():
                return
            try:
                clean_registries(self._queue)
                worker_registration.clean_worker_registry(self._queue)
            finally:
                self._queue.release_maintenance_lock()  # type: ignore[no-untyped-call]

    def workers(self) -> list[str]:
        """See `Queue.workers`."""
        with reachable():
            names = sorted(key.rsplit(":", 1)[1] for key in worker_registration.get_keys(queue=self._queue))
            pipe = self._redis.pipeline(transaction=False)
            for name in names:
                pipe.exists(alive_key(self._name, name))
            return [name for name, alive in zip(names, pipe.execute(), strict=True) if alive]

    def memories(self) -> dict[str, int]:
        """See `Queue.memories`."""
        names = self.workers()
        with reachable():
            signs = self._redis.mget([alive_key(self._name, name) for name in names]) if names else []
        stated = {name: sign.decode().partition(" ")[2] for name, sign in zip(names, signs, strict=True) if sign is not None}
        return {name: int(size) for name, size in stated.items() if size.isdigit()}

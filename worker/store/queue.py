"""The queue: RQ carries attempt ids from the service to the workers, and nothing else."""

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
"""Seconds for which RQ keeps its entry of a failed delivery; the job record is authoritative."""


def alive_key(queue: str, worker: str) -> str:
    """Return the key that expires with its worker (RQ's own entry outlives a killed worker by minutes)."""
    return f"{queue}:worker:{worker}"


class Queue(ABC):
    """The order in which attempts run."""

    @abstractmethod
    def push(self, id: str, attempt_id: str, *, front: bool = False) -> None:
        """Append an attempt, or put it first; nothing happens if it is queued already."""

    @abstractmethod
    def remove(self, attempt_id: str) -> None:
        """Remove an attempt, whether it is queued or held back."""

    @abstractmethod
    def hold(self, attempt_id: str) -> None:
        """Mark an attempt as held back until fewer of its owner's jobs run."""

    @abstractmethod
    def held(self) -> set[str]:
        """Return the ids of the attempts that are held back."""

    @abstractmethod
    def release(self, attempt_id: str) -> None:
        """Remove the mark that an attempt is held back; it is not queued."""

    @abstractmethod
    def waiting(self) -> list[str]:
        """Return the ids of all queued attempts, next one first."""

    @abstractmethod
    def place(self, attempt_id: str) -> int | None:
        """Return the number of attempts ahead of this one, None if it is not queued."""

    @abstractmethod
    def order(self, ranks: Mapping[str, int]) -> None:
        """Sort these attempts by rank, ascending and stable, within the queue positions that they occupy."""

    @abstractmethod
    def clean_up(self) -> None:
        """Remove entries of ended workers from RQ's records."""

    @abstractmethod
    def workers(self) -> list[str]:
        """Return the names of the workers with a recent heartbeat."""

    @abstractmethod
    def memories(self) -> dict[str, int]:
        """Return the bytes available to a job on each of these workers, by name; 0 if unknown."""


class RedisQueue(Queue):
    """RQ on Redis, JSON only. With a single queue RQ moves ids by BLMOVE and cannot lose one in between."""

    def __init__(self, client: redis.Redis, *, name: str) -> None:
        self._redis: Any = client
        self._name = name
        self._held = f"{name}:held"
        self._order = client.register_script(_ORDER)
        self._queue = RqQueue(name, connection=client, serializer=JSONSerializer)

    def push(self, id: str, attempt_id: str, *, front: bool = False) -> None:
        with reachable():
            if self._redis.lpos(self._queue.key, attempt_id) is not None:
                return
            self._queue.enqueue_call(
                FUNCTION,
                args=(id, attempt_id),
                job_id=attempt_id,
                timeout=-1,  # the worker enforces the time limit, since RQ's alarm cannot end a C call
                result_ttl=0,
                failure_ttl=FAILURE_KEPT,
                description=f"job {id}",
                at_front=front,
            )

    def remove(self, attempt_id: str) -> None:
        self.release(attempt_id)
        with reachable():
            for key in (self._queue.key, self._queue.intermediate_queue_key):
                self._redis.lrem(key, 0, attempt_id)
            try:
                RqJob.fetch(attempt_id, connection=self._redis, serializer=JSONSerializer).delete()
            except (NoSuchJobError, InvalidJobOperation):  # removed already
                return
            except ValueError:  # the worker is removing the entry at the same time, which RQ reports as an error
                self._redis.delete(RqJob.key_for(attempt_id))

    def hold(self, attempt_id: str) -> None:
        with reachable():
            self._redis.sadd(self._held, attempt_id)

    def held(self) -> set[str]:
        with reachable():
            return {attempt_id.decode() for attempt_id in self._redis.smembers(self._held)}

    def release(self, attempt_id: str) -> None:
        with reachable():
            self._redis.srem(self._held, attempt_id)

    def waiting(self) -> list[str]:
        with reachable():
            return [attempt_id.decode() for attempt_id in self._redis.lrange(self._queue.key, 0, -1)]

    def place(self, attempt_id: str) -> int | None:
        with reachable():
            place: int | None = self._redis.lpos(self._queue.key, attempt_id)
        return place

    def order(self, ranks: Mapping[str, int]) -> None:
        with reachable():
            self._order(keys=[self._queue.key], args=[part for each in ranks.items() for part in each])

    def clean_up(self) -> None:
        with reachable():
            if not self._queue.acquire_maintenance_lock():
                return
            try:
                clean_registries(self._queue)
                worker_registration.clean_worker_registry(self._queue)
            finally:
                self._queue.release_maintenance_lock()  # type: ignore[no-untyped-call]

    def workers(self) -> list[str]:
        with reachable():
            names = sorted(key.rsplit(":", 1)[1] for key in worker_registration.get_keys(queue=self._queue))
            pipe = self._redis.pipeline(transaction=False)
            for name in names:
                pipe.exists(alive_key(self._name, name))
            return [name for name, alive in zip(names, pipe.execute(), strict=True) if alive]

    def memories(self) -> dict[str, int]:
        names = self.workers()
        with reachable():
            signs = self._redis.mget([alive_key(self._name, name) for name in names]) if names else []
        return {name: int(sign.split()[1]) for name, sign in zip(names, signs, strict=True) if sign is not None}

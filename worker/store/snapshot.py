"""Export and import of stored records, for backups: each job is read atomically, tokens and counters separately."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from pliant.schemas.job import Status
from pliant.worker.records import Stored
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect, reachable
from pliant.worker.store.redis import RedisRecords
from pliant.worker.store.schema import migrated

# ARGV: 1 prefix, 2 id. Record, log and pending webhook are read atomically.
_READ = """
local at = ARGV[1]
local body = redis.call('HGET', at .. 'job:' .. ARGV[2], 'body')
if not body then return false end
return {body, redis.call('LRANGE', at .. 'log:' .. ARGV[2], 0, -1), redis.call('ZSCORE', at .. 'outbox', ARGV[2]),
  redis.call('HGET', at .. 'outbox:tries', ARGV[2])}
"""


class Snapshot:
    """The records of one installation, read and written as plain values. Every method may raise `StoreUnavailable`."""

    def __init__(self, settings: Settings) -> None:
        client = connect(settings.redis, decode=True)
        self._redis: Any = client
        self._at = f"{settings.queue}:"
        self._records = RedisRecords(client, prefix=settings.queue)
        self._read = client.register_script(_READ)

    def jobs(self) -> Iterator[dict[str, Any]]:
        """Yield every job that exists throughout once: its record, its log and its undelivered webhook.

        Their ids are read at one moment, since jobs change their status while the caller copies files.
        """
        for id in self._records.ids(*Status):
            found = self.job(id)
            if found is not None:
                yield found

    def job(self, id: str) -> dict[str, Any] | None:
        """Return one job, None if it does not exist."""
        with reachable():
            found = self._read(args=[self._at, id])
        if found is None:
            return None
        body, log, due, tries = found
        return {"record": json.loads(body), "log": log, "due": due, "tries": tries}

    def rest(self) -> dict[str, dict[str, str]]:
        """Return the data that belongs to no job: tokens, and the counters since the installation was created."""
        with reachable():
            return {name: self._redis.hgetall(f"{self._at}{name}") for name in ("tokens", "tally")}

    def is_empty(self) -> bool:
        """Return True if there is no job and no token."""
        return self._records.count(list(Status)) == 0 and not self.rest()["tokens"]

    def write(self, job: dict[str, Any]) -> Stored:
        """Write a job of a snapshot, migrated if it is older; the store must not contain its id."""
        stored = self._records.create(Stored.model_validate(migrated(job["record"])))
        self._records.append_log(stored.job.id, job["log"])
        if job["due"] is not None:
            with reachable():
                self._redis.zadd(f"{self._at}outbox", {stored.job.id: float(job["due"])})
                self._redis.hset(f"{self._at}outbox:tries", stored.job.id, int(job["tries"] or 0))
        return stored

    def write_rest(self, rest: dict[str, dict[str, str]]) -> None:
        """Write tokens and counters."""
        with reachable():
            for name in ("tokens", "tally"):
                if rest.get(name):
                    self._redis.hset(f"{self._at}{name}", mapping=rest[name])

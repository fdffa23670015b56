"""Job records in Redis.

Keys, all under one prefix::

    job:<id>              hash: version, status, token, owner, sort, bytes, key, beat, most, body (JSON of `Stored`)
    index:*:<status>      sorted set of sort keys, all jobs of a status; index:@<owner>:<status> the owner's
    events:<id>, log:<id> stream and list, both capped
    key:<digest>          the job of an idempotency key
    used                  bytes that all jobs hold
    tally                 hash: what has been counted since the installation began
    outbox, outbox:tries  jobs whose end is to be told by webhook and when; how often it was tried (`worker.outbox`)

Each write is one Lua script, hence atomic; the append-only file holds it wholly or not at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import Any

import redis
from pliant.schemas.job import Status
from pliant.worker.errors import TooManyQueued, UnknownJob
from pliant.worker.records import (
    LOG_KEPT,
    Beat,
    Event,
    Records,
    Stored,
    counted,
    event_of,
    events_kept,
    moment,
    told_at,
)
from pliant.worker.store.connection import reachable

LONGEST_WAIT = 20.0
"""Seconds one blocking read waits at most: below the connection's own timeout."""

# ARGV: 1 prefix, 2 id, 3 version, 4 status, 5 token, 6 owner, 7 sort key, 8 bytes, 9 key digest, 10 body, 11 event, 12 data, 13 cap,
# 14 most queued jobs of the owner (0: any), 15 most running ones as its token said ('': nothing)
_CREATE = """
local at = ARGV[1]
if ARGV[9] ~= '' then
  local taken = redis.call('GET', at .. 'key:' .. ARGV[9])
  if taken then return taken end
end
if redis.call('EXISTS', at .. 'job:' .. ARGV[2]) == 1 then return ARGV[2] end
local most = tonumber(ARGV[14])
if most > 0 and redis.call('ZCARD', at .. 'index:@' .. ARGV[6] .. ':queued') >= most then return '!full' end
if ARGV[9] ~= '' then redis.call('SET', at .. 'key:' .. ARGV[9], ARGV[2]) end
redis.call('HSET', at .. 'job:' .. ARGV[2], 'version', ARGV[3], 'status', ARGV[4], 'token', ARGV[5], 'owner', ARGV[6],
  'sort', ARGV[7], 'bytes', ARGV[8], 'key', ARGV[9], 'body', ARGV[10], 'beat', 0,
  'most', ARGV[15])
redis.call('ZADD', at .. 'index:*:' .. ARGV[4], 0, ARGV[7])
redis.call('ZADD', at .. 'index:@' .. ARGV[6] .. ':' .. ARGV[4], 0, ARGV[7])
redis.call('INCRBY', at .. 'used', ARGV[8])
redis.call('XADD', at .. 'events:' .. ARGV[2], 'MAXLEN', ARGV[13], '*', 'name', ARGV[11], 'data', ARGV[12])
return false
"""

_FULL = "!full"
"""What `_CREATE` answers instead of an id when the owner's queue is full; no id begins with this sign."""

# ARGV: 1 prefix, 2 id, 3 version before, 4 version, 5 status, 6 token, 7 bytes, 8 body, 9 event, 10 data, 11 cap,
# 12 when to tell it by webhook ('': never), 13 … tallies and what to add to them
_REPLACE = """
local at, job = ARGV[1], ARGV[1] .. 'job:' .. ARGV[2]
local held = redis.call('HMGET', job, 'version', 'status', 'owner', 'sort', 'bytes')
if held[1] ~= ARGV[3] then return 0 end
redis.call('HSET', job, 'version', ARGV[4], 'status', ARGV[5], 'token', ARGV[6], 'bytes', ARGV[7], 'body', ARGV[8])
if held[2] ~= ARGV[5] then
  for _, who in ipairs({'*', '@' .. held[3]}) do
    redis.call('ZREM', at .. 'index:' .. who .. ':' .. held[2], held[4])
    redis.call('ZADD', at .. 'index:' .. who .. ':' .. ARGV[5], 0, held[4])
  end
end
if held[5] ~= ARGV[7] then redis.call('INCRBY', at .. 'used', tonumber(ARGV[7]) - tonumber(held[5])) end
redis.call('XADD', at .. 'events:' .. ARGV[2], 'MAXLEN', ARGV[11], '*', 'name', ARGV[9], 'data', ARGV[10])
if ARGV[12] ~= '' then redis.call('ZADD', at .. 'outbox', ARGV[12], ARGV[2]) end
for i = 13, #ARGV, 2 do redis.call('HINCRBYFLOAT', at .. 'tally', ARGV[i], ARGV[i + 1]) end
return 1
"""

# ARGV: 1 prefix, 2 id
_DELETE = """
local at, job = ARGV[1], ARGV[1] .. 'job:' .. ARGV[2]
local held = redis.call('HMGET', job, 'status', 'owner', 'sort', 'bytes', 'key')
if not held[1] then return 0 end
redis.call('ZREM', at .. 'index:*:' .. held[1], held[3])
redis.call('ZREM', at .. 'index:@' .. held[2] .. ':' .. held[1], held[3])
redis.call('DECRBY', at .. 'used', held[4])
if held[5] ~= '' then redis.call('DEL', at .. 'key:' .. held[5]) end
redis.call('ZREM', at .. 'outbox', ARGV[2])
redis.call('HDEL', at .. 'outbox:tries', ARGV[2])
redis.call('DEL', job, at .. 'events:' .. ARGV[2], at .. 'log:' .. ARGV[2])
return 1
"""

# ARGV: 1 prefix, 2 id, 3 token
_BEAT = """
local job = ARGV[1] .. 'job:' .. ARGV[2]
local held = redis.call('HMGET', job, 'token', 'status')
if held[1] ~= ARGV[3] then return false end
redis.call('HINCRBY', job, 'beat', 1)
return held[2]
"""

# ARGV: 1 prefix, 2 id, 3 cap, 4 … lines
_LOG = """
if redis.call('EXISTS', ARGV[1] .. 'job:' .. ARGV[2]) == 0 then return 0 end
for i = 4, #ARGV do redis.call('RPUSH', ARGV[1] .. 'log:' .. ARGV[2], ARGV[i]) end
redis.call('LTRIM', ARGV[1] .. 'log:' .. ARGV[2], -tonumber(ARGV[3]), -1)
return 1
"""


class RedisRecords(Records):
    """Records in Redis under one key prefix."""

    def __init__(self, client: redis.Redis, *, prefix: str, waiting: redis.Redis | None = None) -> None:
        self._redis: Any = client  # redis-py types every answer as a union with its awaitable twin
        self._waiting: Any = waiting or client
        """Blocks for up to `LONGEST_WAIT`."""
        self._at = f"{prefix}:"
        self._create = client.register_script(_CREATE)
        self._replace = client.register_script(_REPLACE)
        self._delete = client.register_script(_DELETE)
        self._beat = client.register_script(_BEAT)
        self._log = client.register_script(_LOG)

    def create(self, stored: Stored, *, max_queued: int = 0) -> Stored:
        """See `Records.create`."""
        name, data = event_of(None, stored)
        job = stored.job
        with reachable():
            taken = self._create(
                args=[
                    self._at, job.id, stored.version, job.status.value, stored.token, stored.owner, stored.sort_key,
                    stored.bytes, stored.key or "", stored.model_dump_json(), name, data, events_kept(stored),
                    max_queued, "" if stored.max_running is None else stored.max_running,
                ]
            )  # fmt: skip
        if taken == _FULL:
            raise TooManyQueued(max_queued)
        return stored if taken is None else self.get(str(taken))

    def get(self, id: str) -> Stored:
        """See `Records.get`."""
        with reachable():
            body = self._redis.hget(f"{self._at}job:{id}", "body")
        if body is None:
            raise UnknownJob(id)
        return Stored.model_validate_json(body)

    def find(self, key: str) -> Stored | None:
        """See `Records.find`."""
        with reachable():
            id = self._redis.get(f"{self._at}key:{key}")
        return None if id is None else self.get(id)

    def replace(self, before: Stored, after: Stored) -> bool:
        """See `Records.replace`."""
        name, data = event_of(before, after)
        job, due = after.job, told_at(before, after)
        with reachable():
            written = self._replace(
                args=[
                    self._at, job.id, before.version, after.version, job.status.value, after.token, after.bytes,
                    after.model_dump_json(), name, data, events_kept(after),
                    "" if due is None else due, *(part for each in counted(before, after).items() for part in each),
                ]
            )  # fmt: skip
        return bool(written)

    def delete(self, id: str) -> None:
        """See `Records.delete`."""
        with reachable():
            self._delete(args=[self._at, id])

    def page(
        self, *, cursor: str | None, limit: int, statuses: Sequence[Status], owner: str | None
    ) -> tuple[list[Stored], str | None]:
        """See `Records.page`."""
        newest = "+" if cursor is None else f"({cursor}"
        with reachable():
            pipe = self._redis.pipeline(transaction=False)
            for status in dict.fromkeys(statuses):
                pipe.zrevrangebylex(self._index(owner, status), newest, "-", start=0, num=limit + 1)
            keys = sorted({key for each in pipe.execute() for key in each}, reverse=True)
            pipe = self._redis.pipeline(transaction=False)
            for key in keys[:limit]:
                pipe.hget(f"{self._at}job:{key.split(':', 1)[1]}", "body")
            bodies = pipe.execute()
        page = [Stored.model_validate_json(body) for body in bodies if body is not None]
        return page, keys[limit - 1] if len(keys) > limit else None

    def ids(self, status: Status) -> list[str]:
        """See `Records.ids`."""
        with reachable():
            keys = self._redis.zrange(self._index(None, status), 0, -1)
        return [key.split(":", 1)[1] for key in keys]

    def count(self, statuses: Sequence[Status], *, owner: str | None = None) -> int:
        """See `Records.count`."""
        with reachable():
            return sum(self._redis.zcard(self._index(owner, status)) for status in dict.fromkeys(statuses))

    def oldest(self, status: Status) -> datetime | None:
        """See `Records.oldest`."""
        with reachable():
            first = self._redis.zrange(self._index(None, status), 0, 0)
        return moment(int(first[0].split(":", 1)[0])) if first else None

    def tallies(self) -> dict[str, float]:
        """See `Records.tallies`."""
        with reachable():
            return {name: float(value) for name, value in self._redis.hgetall(f"{self._at}tally").items()}

    def used(self) -> int:
        """See `Records.used`."""
        with reachable():
            return int(self._redis.get(f"{self._at}used") or 0)

    def beat(self, id: str, token: str) -> Status | None:
        """See `Records.beat`."""
        with reachable():
            status = self._beat(args=[self._at, id, token])
        return None if status is None else Status(str(status))

    def look(self, id: str, token: str) -> Status | None:
        """See `Records.look`."""
        with reachable():
            held, status = self._redis.hmget(f"{self._at}job:{id}", "token", "status")
        return Status(status) if held == token else None

    def beats(self, ids: Iterable[str]) -> dict[str, Beat]:
        """See `Records.beats`."""
        wanted = list(ids)
        with reachable():
            pipe = self._redis.pipeline(transaction=False)
            for id in wanted:
                pipe.hmget(f"{self._at}job:{id}", "token", "beat", "owner", "most")
            answers = pipe.execute()
        return {
            id: Beat(token, int(beat), owner, int(most) if most else None)
            for id, (token, beat, owner, most) in zip(wanted, answers, strict=True)
            if token is not None
        }

    def events(self, id: str, *, after: str | None, timeout: float) -> list[Event]:
        """See `Records.events`."""
        key = f"{self._at}events:{id}"
        wait = max(0.0, min(timeout, LONGEST_WAIT))
        with reachable():
            if not self._redis.exists(key):
                return []
            # BLOCK 0 would wait for ever.
            block = {"block": max(1, int(wait * 1000))} if wait > 0 else {}
            answer = self._waiting.xread({key: after or "0-0"}, **block)
        streams = answer.values() if isinstance(answer, dict) else [each[1] for each in answer or []]
        entries = [entry for stream in streams for entry in _flat(stream)]
        return [Event(entry, fields["name"], fields["data"]) for entry, fields in entries]

    def append_log(self, id: str, lines: Sequence[str]) -> None:
        """See `Records.append_log`."""
        if lines:
            with reachable():
                self._log(args=[self._at, id, LOG_KEPT, *lines[-LOG_KEPT:]])

    def log(self, id: str) -> list[str]:
        """See `Records.log`."""
        with reachable():
            return list(self._redis.lrange(f"{self._at}log:{id}", 0, -1))

    def ping(self) -> None:
        """See `Records.ping`."""
        with reachable():
            self._redis.ping()

    def _index(self, owner: str | None, status: Status) -> str:
        who = "*" if owner is None else f"@{owner}"
        return f"{self._at}index:{who}:{status.value}"


def _flat(stream: Any) -> list[Any]:
    """RESP3 answers `[[entry, …]]` for a stream where RESP2 answers `[entry, …]`."""
    return [entry for each in stream for entry in (each if each and not isinstance(each[0], str) else [each])]

"""Job records in Redis.

Keys, all under one prefix::

    job:<id>              hash: version, status, token (the attempt id), owner, sort, bytes, key, beat, most, priority,
                          body (JSON of `Stored`)
    index:*:<status>      sorted set of sort keys, all jobs of a status; index:@<owner>:<status> the owner's
    events:<id>, log:<id> stream and list, both capped
    key:<digest>          the job of an idempotency key
    used                  bytes of all jobs
    schema                version of the records
    deleted               sorted set of deleted jobs whose files are still to be removed, by time of deletion
    changes               channel on which the id of every changed job is published
    tally                 hash: counters since the installation was created
    outbox, outbox:tries  jobs with a pending webhook and when it is due; number of attempts (`store.outbox`)

Each write is one Lua script and therefore atomic, also in the append-only file. Before the first use, the permissions of the server's
user (`store.permissions`) and the version of the records are checked (`store.schema`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from typing import Any

import redis
from pliant.schemas.job import Status
from pliant.worker.errors import QuotaExceeded, TooManyQueued, UnknownJob
from pliant.worker.records import (
    LOG_KEPT,
    Changes,
    Event,
    Heartbeat,
    Records,
    Stored,
    counted,
    event_of,
    events_kept,
    milliseconds,
    moment,
    webhook_due,
)
from pliant.worker.store.changes import RedisChanges
from pliant.worker.store.connection import reachable
from pliant.worker.store.permissions import check_permissions
from pliant.worker.store.schema import prepare

# ARGV: 1 prefix, 2 id, 3 version, 4 status, 5 attempt id, 6 owner, 7 sort key, 8 bytes, 9 key digest, 10 body, 11 event, 12 data, 13 cap,
# 14 maximum queued jobs of the owner (0: no limit), 15 maximum running ones by the owner's token ('': not set),
# 16 maximum bytes of all jobs (0: no limit), 17 priority
_CREATE = """
local at = ARGV[1]
if ARGV[9] ~= '' then
  local taken = redis.call('GET', at .. 'key:' .. ARGV[9])
  if taken and redis.call('EXISTS', at .. 'job:' .. taken) == 1 then return taken end
end
if redis.call('EXISTS', at .. 'job:' .. ARGV[2]) == 1 then return ARGV[2] end
local most = tonumber(ARGV[14])
if most > 0 and redis.call('ZCARD', at .. 'index:@' .. ARGV[6] .. ':queued') >= most then return '!full' end
local bytes = tonumber(ARGV[16])
if bytes > 0 and tonumber(redis.call('GET', at .. 'used') or 0) + tonumber(ARGV[8]) > bytes then return '!space' end
if ARGV[9] ~= '' then redis.call('SET', at .. 'key:' .. ARGV[9], ARGV[2]) end
redis.call('HSET', at .. 'job:' .. ARGV[2], 'version', ARGV[3], 'status', ARGV[4], 'token', ARGV[5], 'owner', ARGV[6],
  'sort', ARGV[7], 'bytes', ARGV[8], 'key', ARGV[9], 'body', ARGV[10], 'beat', 0,
  'most', ARGV[15], 'priority', ARGV[17])
redis.call('ZADD', at .. 'index:*:' .. ARGV[4], 0, ARGV[7])
redis.call('ZADD', at .. 'index:@' .. ARGV[6] .. ':' .. ARGV[4], 0, ARGV[7])
redis.call('INCRBY', at .. 'used', ARGV[8])
redis.call('XADD', at .. 'events:' .. ARGV[2], 'MAXLEN', ARGV[13], '*', 'name', ARGV[11], 'data', ARGV[12])
redis.call('PUBLISH', at .. 'changes', ARGV[2])
return false
"""

_FULL, _NO_SPACE = "!full", "!space"
"""Results of `_CREATE` when the owner's queue or the quota is full; ids never start with this character."""

# ARGV: 1 prefix, 2 id, 3 version before, 4 version, 5 status, 6 attempt id, 7 bytes, 8 body, 9 event ('': none), 10 data, 11 cap,
# 12 when the webhook is due ('': none), 13 … counters and their increments. A repetition after a lost reply succeeds, too.
_REPLACE = """
local at, job = ARGV[1], ARGV[1] .. 'job:' .. ARGV[2]
local held = redis.call('HMGET', job, 'version', 'status', 'owner', 'sort', 'bytes', 'body')
if held[1] == ARGV[4] and held[6] == ARGV[8] then return 1 end
if held[1] ~= ARGV[3] then return 0 end
redis.call('HSET', job, 'version', ARGV[4], 'status', ARGV[5], 'token', ARGV[6], 'bytes', ARGV[7], 'body', ARGV[8])
if held[2] ~= ARGV[5] then
  for _, who in ipairs({'*', '@' .. held[3]}) do
    redis.call('ZREM', at .. 'index:' .. who .. ':' .. held[2], held[4])
    redis.call('ZADD', at .. 'index:' .. who .. ':' .. ARGV[5], 0, held[4])
  end
end
if held[5] ~= ARGV[7] then redis.call('INCRBY', at .. 'used', tonumber(ARGV[7]) - tonumber(held[5])) end
if ARGV[9] ~= '' then
  redis.call('XADD', at .. 'events:' .. ARGV[2], 'MAXLEN', ARGV[11], '*', 'name', ARGV[9], 'data', ARGV[10])
end
redis.call('PUBLISH', at .. 'changes', ARGV[2])
if ARGV[12] ~= '' then redis.call('ZADD', at .. 'outbox', ARGV[12], ARGV[2]) end
for i = 13, #ARGV, 2 do redis.call('HINCRBYFLOAT', at .. 'tally', ARGV[i], ARGV[i + 1]) end
return 1
"""

# ARGV: 1 prefix, 2 id, 3 milliseconds since 1970, 4 attempt id
_DELETE = """
local at, job = ARGV[1], ARGV[1] .. 'job:' .. ARGV[2]
local held = redis.call('HMGET', job, 'status', 'owner', 'sort', 'bytes', 'key', 'token')
if held[6] ~= ARGV[4] then return 0 end
redis.call('ZREM', at .. 'index:*:' .. held[1], held[3])
redis.call('ZREM', at .. 'index:@' .. held[2] .. ':' .. held[1], held[3])
redis.call('DECRBY', at .. 'used', held[4])
if held[5] ~= '' then redis.call('DEL', at .. 'key:' .. held[5]) end
redis.call('ZADD', at .. 'deleted', ARGV[3], ARGV[2])
redis.call('ZREM', at .. 'outbox', ARGV[2])
redis.call('HDEL', at .. 'outbox:tries', ARGV[2])
redis.call('DEL', job, at .. 'events:' .. ARGV[2], at .. 'log:' .. ARGV[2])
redis.call('PUBLISH', at .. 'changes', ARGV[2])
return 1
"""

# ARGV: 1 prefix, 2 id, 3 attempt id
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

    def __init__(self, client: redis.Redis, *, prefix: str) -> None:
        self._redis: Any = client  # redis-py types every reply as a union with its awaitable counterpart
        self._prefix, self._at = prefix, f"{prefix}:"
        self._is_current = False
        self._create = client.register_script(_CREATE)
        self._replace = client.register_script(_REPLACE)
        self._delete = client.register_script(_DELETE)
        self._beat = client.register_script(_BEAT)
        self._log = client.register_script(_LOG)

    @contextmanager
    def _checked(self) -> Iterator[None]:
        """Translate errors of the store; before the first use, check permissions and the version of the records, and migrate older ones."""
        with reachable():
            if not self._is_current:
                check_permissions(self._redis, self._prefix)
                prepare(self._redis, self._prefix)
                self._is_current = True
            yield

    def create(self, stored: Stored, *, max_queued: int = 0, max_bytes: int = 0) -> Stored:
        event, job = event_of(None, stored), stored.job
        assert event is not None
        with self._checked():
            taken = self._create(
                args=[
                    self._at, job.id, stored.version, job.status.value, stored.attempt_id, stored.owner, stored.sort_key,
                    stored.bytes, stored.key or "", stored.model_dump_json(), *event, events_kept(stored),
                    max_queued, "" if stored.max_running is None else stored.max_running, max_bytes, job.priority,
                ]
            )  # fmt: skip
        if taken == _FULL:
            raise TooManyQueued(max_queued)
        if taken == _NO_SPACE:
            raise QuotaExceeded(used=self.used(), quota=max_bytes, needed=stored.bytes, results=stored.reserved)
        if taken is None:
            return stored
        try:
            return self.get(str(taken))
        except UnknownJob:  # deleted in between, so that the key is free
            return self.create(stored, max_queued=max_queued, max_bytes=max_bytes)

    def get(self, id: str) -> Stored:
        with self._checked():
            body = self._redis.hget(f"{self._at}job:{id}", "body")
        if body is None:
            raise UnknownJob(id)
        return Stored.model_validate_json(body)

    def find(self, key: str) -> Stored | None:
        with self._checked():
            id = self._redis.get(f"{self._at}key:{key}")
        try:
            return None if id is None else self.get(id)
        except UnknownJob:  # deleted in between
            return None

    def replace(self, before: Stored, after: Stored) -> bool:
        name, data = event_of(before, after) or ("", "")
        job, due = after.job, webhook_due(before, after)
        with self._checked():
            written = self._replace(
                args=[
                    self._at, job.id, before.version, after.version, job.status.value, after.attempt_id, after.bytes,
                    after.model_dump_json(), name, data, events_kept(after),
                    "" if due is None else due, *(part for each in counted(before, after).items() for part in each),
                ]
            )  # fmt: skip
        return bool(written)

    def delete(self, stored: Stored, *, at: datetime) -> None:
        with self._checked():
            self._delete(args=[self._at, stored.job.id, milliseconds(at), stored.attempt_id])

    def deleted(self) -> dict[str, datetime]:
        with self._checked():
            found = self._redis.zrange(f"{self._at}deleted", 0, -1, withscores=True)
        return {id: moment(int(at)) for id, at in found}

    def forget_deleted(self, id: str) -> None:
        with self._checked():
            self._redis.zrem(f"{self._at}deleted", id)

    def page(
        self, *, cursor: str | None, limit: int, statuses: Sequence[Status], owner: str | None
    ) -> tuple[list[Stored], str | None]:
        newest = "+" if cursor is None else f"({cursor}"
        with self._checked():
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

    def ids(self, *statuses: Status) -> list[str]:
        with self._checked():
            pipe = self._redis.pipeline(transaction=True)
            for status in statuses:
                pipe.zrange(self._index(None, status), 0, -1)
            found = pipe.execute()
        return [key.split(":", 1)[1] for keys in found for key in keys]

    def count(self, statuses: Sequence[Status], *, owner: str | None = None) -> int:
        with self._checked():
            return sum(self._redis.zcard(self._index(owner, status)) for status in dict.fromkeys(statuses))

    def oldest(self, status: Status) -> datetime | None:
        with self._checked():
            first = self._redis.zrange(self._index(None, status), 0, 0)
        return moment(int(first[0].split(":", 1)[0])) if first else None

    def tallies(self) -> dict[str, float]:
        with self._checked():
            return {name: float(value) for name, value in self._redis.hgetall(f"{self._at}tally").items()}

    def used(self) -> int:
        with self._checked():
            return int(self._redis.get(f"{self._at}used") or 0)

    def beat(self, id: str, attempt_id: str) -> Status | None:
        with self._checked():
            status = self._beat(args=[self._at, id, attempt_id])
        return None if status is None else Status(str(status))

    def look(self, id: str, attempt_id: str) -> Status | None:
        with self._checked():
            held, status = self._redis.hmget(f"{self._at}job:{id}", "token", "status")
        return Status(status) if held == attempt_id else None

    def beats(self, ids: Iterable[str]) -> dict[str, Heartbeat]:
        wanted = list(ids)
        with self._checked():
            pipe = self._redis.pipeline(transaction=False)
            for id in wanted:
                pipe.hmget(f"{self._at}job:{id}", "token", "beat", "owner", "most", "priority")
            answers = pipe.execute()
        return {
            id: Heartbeat(attempt_id, int(beat), owner, int(most) if most else None, priority or "normal")
            for id, (attempt_id, beat, owner, most, priority) in zip(wanted, answers, strict=True)
            if attempt_id is not None
        }

    def events(self, id: str, *, after: str | None) -> list[Event]:
        with self._checked():
            entries = self._redis.xrange(f"{self._at}events:{id}", min="-" if after is None else f"({after}", max="+")
        return [Event(entry, fields["name"], fields["data"]) for entry, fields in entries]

    def changes(self) -> Changes:
        return RedisChanges(self._redis, prefix=self._prefix)

    def append_log(self, id: str, lines: Sequence[str]) -> None:
        if lines:
            with self._checked():
                self._log(args=[self._at, id, LOG_KEPT, *lines[-LOG_KEPT:]])

    def log(self, id: str) -> list[str]:
        with self._checked():
            return list(self._redis.lrange(f"{self._at}log:{id}", 0, -1))

    def ping(self) -> None:
        with self._checked():
            self._redis.ping()

    def _index(self, owner: str | None, status: Status) -> str:
        who = "*" if owner is None else f"@{owner}"
        return f"{self._at}index:{who}:{status.value}"

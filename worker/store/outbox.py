"""The outbox: finished jobs with a pending webhook. An entry is written atomically with the job's final status.

Webhooks are therefore delivered at least once, whichever process is killed; receivers recognise duplicates by `webhook-id`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import redis
from pliant.worker.store.connection import reachable

# ARGV: 1 prefix, 2 now, 3 end of the lease. Returns id and number of attempts, including this one.
_TAKE = """
local at = ARGV[1]
local due = redis.call('ZRANGEBYSCORE', at .. 'outbox', '-inf', ARGV[2], 'LIMIT', 0, 1)
if not due[1] then return false end
redis.call('ZADD', at .. 'outbox', ARGV[3], due[1])
redis.call('HINCRBY', at .. 'tally', 'webhooks:tried', 1)
return {due[1], redis.call('HINCRBY', at .. 'outbox:tries', due[1], 1)}
"""

# A job that was deleted or retried since may have another message under the same id, whose entry is then no longer due at the
# end of this lease. ARGV: 1 prefix, 2 id, 3 end of the lease
_LEASED = """
if tonumber(redis.call('ZSCORE', ARGV[1] .. 'outbox', ARGV[2]) or -1) ~= tonumber(ARGV[3]) then return 0 end
"""

# ARGV: 4 when it is due, 5 attempts to add, 0 or -1. Not subtracted here: Redis 7.0 would pass -0 as "-0", which HINCRBY refuses.
_LATER = f"""{_LEASED}
redis.call('ZADD', ARGV[1] .. 'outbox', ARGV[4], ARGV[2])
redis.call('HINCRBY', ARGV[1] .. 'outbox:tries', ARGV[2], ARGV[5])
redis.call('HINCRBY', ARGV[1] .. 'tally', 'webhooks:tried', ARGV[5])
return 1
"""

# ARGV: 4 name of the tally
_CLOSE = f"""{_LEASED}
redis.call('ZREM', ARGV[1] .. 'outbox', ARGV[2])
redis.call('HDEL', ARGV[1] .. 'outbox:tries', ARGV[2])
redis.call('HINCRBY', ARGV[1] .. 'tally', ARGV[4], 1)
return 1
"""


@dataclass(frozen=True, slots=True)
class Lease:
    """A message that is being sent."""

    id: str
    """The job."""

    tries: int
    """Number of leases, including this one."""

    until: int
    """When others may take the message, milliseconds since 1970."""


class Outbox:
    """The pending messages. All times in milliseconds since 1970; every method may raise `StoreUnavailable`.

    A lease that is over, since its job was deleted or another process took the message, changes nothing.
    """

    def __init__(self, client: redis.Redis, *, prefix: str) -> None:
        self._at = f"{prefix}:"
        self._take = client.register_script(_TAKE)
        self._later = client.register_script(_LATER)
        self._close = client.register_script(_CLOSE)

    def take(self, *, now: int, until: int) -> Lease | None:
        """Lease the message that has been due longest, until the time `until`; return None if none is due."""
        with reachable():
            found: Any = self._take(args=[self._at, now, until])
        return None if found is None else Lease(str(found[0]), int(found[1]), until)

    def delivered(self, lease: Lease) -> None:
        """Remove a delivered message."""
        self._closed(lease, "webhooks:delivered")

    def given_up(self, lease: Lease) -> None:
        """Remove a message that cannot be delivered."""
        self._closed(lease, "webhooks:given_up")

    def later(self, lease: Lease, *, due: int) -> None:
        """Schedule the next attempt at a message."""
        self._scheduled(lease, due, added=0)

    def postpone(self, lease: Lease, *, due: int) -> None:
        """Return a leased message that was not sent; the lease does not count as an attempt."""
        self._scheduled(lease, due, added=-1)

    def _scheduled(self, lease: Lease, due: int, *, added: int) -> None:
        with reachable():
            self._later(args=[self._at, lease.id, lease.until, due, added])

    def _closed(self, lease: Lease, tally: str) -> None:
        with reachable():
            self._close(args=[self._at, lease.id, lease.until, tally])

"""The outbox: finished jobs with a pending webhook. An entry is written atomically with the job's final status.

Webhooks are therefore delivered at least once, whichever process is killed; receivers recognise duplicates by `webhook-id`.
"""

from __future__ import annotations

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

# ARGV: 1 prefix, 2 id, 3 when it is due
_POSTPONE = """
if redis.call('ZADD', ARGV[1] .. 'outbox', 'XX', 'CH', ARGV[3], ARGV[2]) == 0 then return 0 end
redis.call('HINCRBY', ARGV[1] .. 'outbox:tries', ARGV[2], -1)
redis.call('HINCRBY', ARGV[1] .. 'tally', 'webhooks:tried', -1)
return 1
"""

# ARGV: 1 prefix, 2 id, 3 name of the tally
_CLOSE = """
if redis.call('ZREM', ARGV[1] .. 'outbox', ARGV[2]) == 0 then return 0 end
redis.call('HDEL', ARGV[1] .. 'outbox:tries', ARGV[2])
redis.call('HINCRBY', ARGV[1] .. 'tally', ARGV[3], 1)
return 1
"""


class Outbox:
    """The pending messages. All times in milliseconds since 1970; every method may raise `StoreUnavailable`."""

    def __init__(self, client: redis.Redis, *, prefix: str) -> None:
        self._redis: Any = client
        self._at = f"{prefix}:"
        self._take = client.register_script(_TAKE)
        self._postpone = client.register_script(_POSTPONE)
        self._close = client.register_script(_CLOSE)

    def take(self, *, now: int, until: int) -> tuple[str, int] | None:
        """Lease the message that has been due longest, until the time `until`; return None if none is due.

        Returns
        -------
        id : str
            The job.
        tries : int
            Number of leases, including this one.
        """
        with reachable():
            found = self._take(args=[self._at, now, until])
        return None if found is None else (str(found[0]), int(found[1]))

    def delivered(self, id: str) -> None:
        """Remove a delivered message."""
        self._closed(id, "webhooks:delivered")

    def given_up(self, id: str) -> None:
        """Remove a message that cannot be delivered."""
        self._closed(id, "webhooks:given_up")

    def later(self, id: str, *, due: int) -> None:
        """Schedule the next attempt at a message; nothing happens if its job was deleted."""
        with reachable():
            self._redis.zadd(f"{self._at}outbox", {id: due}, xx=True)

    def postpone(self, id: str, *, due: int) -> None:
        """Return a leased message that was not sent; the lease does not count as an attempt."""
        with reachable():
            self._postpone(args=[self._at, id, due])

    def _closed(self, id: str, tally: str) -> None:
        with reachable():
            self._close(args=[self._at, id, tally])

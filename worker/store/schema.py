"""Version of the stored records, and migrations from older versions.

`RedisRecords` checks the version before its first use. Older data is migrated once; newer data is rejected, because an older program
could drop fields that it does not know.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from typing import Any

import redis
from pliant.worker.errors import JOB_STORE, NewerData, StoreUnavailable

logger = logging.getLogger(__name__)

CURRENT = 2
"""Version of the records that this code writes.

1: no version is stored; everything up to and including 0.1.0 of November 2026.
2: the version is stored, and each record names its schema.
"""

_LOCK_SECONDS = 60
"""Maximum seconds for which one process may migrate while the others wait."""

# ARGV: 1 prefix, 2 id, 3 body before, 4 body. Does nothing if the body has changed meanwhile.
_REWRITE = """
local job = ARGV[1] .. 'job:' .. ARGV[2]
if redis.call('HGET', job, 'body') ~= ARGV[3] then return 0 end
redis.call('HSET', job, 'body', ARGV[4])
return 1
"""


def _name_the_schema(body: dict[str, Any]) -> dict[str, Any]:
    return {**body, "schema": 2}


STEPS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {1: _name_the_schema}
"""Migration of a record's JSON from each version to the next one."""


def migrated(body: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON of a record in the current version.

    Raises
    ------
    NewerData
        The record was written by a newer version.
    """
    version = int(body.get("schema", 1))
    if version > CURRENT:
        raise NewerData(found=version, known=CURRENT)
    for step in range(version, CURRENT):
        body = STEPS[step](body)
    return body


def prepare(client: Any, prefix: str) -> int:
    """Migrate an installation's records to the current version; return how many were rewritten.

    Raises
    ------
    NewerData
        The records were written by a newer version.
    StoreUnavailable
        Another process still migrates the records.
    """
    at = f"{prefix}:"
    version = int(client.get(f"{at}schema") or 0)
    if version == CURRENT:
        return 0
    if version > CURRENT:
        raise NewerData(found=version, known=CURRENT)
    count = 0
    try:
        with client.lock(f"{at}migrating", timeout=_LOCK_SECONDS, blocking_timeout=_LOCK_SECONDS):
            if int(client.get(f"{at}schema") or 0) == CURRENT:  # another process was quicker
                return 0
            count = _rewrite(client, at)
            client.set(f"{at}schema", CURRENT)
    except redis.exceptions.LockNotOwnedError:
        logger.warning("the migration took longer than its lock lasts; another process may have repeated it")
    except redis.exceptions.LockError as error:
        raise StoreUnavailable(JOB_STORE, reason="another process still migrates the records") from error
    if count:
        logger.info("migrated %d job records from version %d to %d", count, version or 1, CURRENT)
    return count


def _rewrite(client: Any, at: str) -> int:
    rewrite, count = client.register_script(_REWRITE), 0
    for key in client.scan_iter(match=f"{_escaped(at)}job:*", count=500):
        id = key.removeprefix(f"{at}job:")
        while (before := client.hget(key, "body")) is not None:
            after = migrated(json.loads(before))
            if rewrite(args=[at, id, before, json.dumps(after, separators=(",", ":"))]):
                count += 1
                break
    return count


def _escaped(text: str) -> str:
    return "".join(f"\\{sign}" if sign in "*?[]\\" else sign for sign in text)

"""What Pliant must be allowed on Redis, checked before the first use: a change that is forbidden half-way would stay half done.

The server checks its own access rules (ACL) in a script, since asking for them is an administrator's right.
"""

from __future__ import annotations

from typing import Any

from pliant.worker.errors import StoreForbidden

# Each command has as many arguments as it needs: the server takes keys from the arguments without counting them, and may crash.
ON_BOTH = (
    "GET k", "SET k v", "DEL k", "EXISTS k", "EXPIRE k 1", "HGET k f", "HGETALL k", "HMGET k f", "HSET k f v", "HDEL k f", "HINCRBY k f 1",
    "HINCRBYFLOAT k f 1", "LRANGE k 0 1", "RPUSH k v", "SADD k v", "SREM k v", "SMEMBERS k", "ZADD k 0 v", "ZCARD k", "ZRANGE k 0 1",
    "ZRANGEBYSCORE k 0 1", "ZREM k v", "ZSCORE k v",
)  # fmt: skip
"""Commands on keys of the installation and on RQ's; `k` stands for the key."""

ON_OWN = (
    "INCRBY k 1", "DECRBY k 1", "MGET k", "HKEYS k", "HVALS k", "LTRIM k 0 1", "XADD k * f v", "XRANGE k - +",
    "ZREVRANGEBYLEX k + -",
)  # fmt: skip
"""Further commands on the installation's keys, which start with the name of the queue."""

ON_RQ = (
    "BLMOVE k k LEFT RIGHT 1",
    "LPOS k v",
    "LPUSH k v",
    "LREM k 0 v",
    "LSET k 0 v",
    "WATCH k",
    "ZREMRANGEBYSCORE k 0 1",
)
"""Further commands on RQ's keys, which start with `rq:`."""

ON_CHANNEL = ("PUBLISH k v", "SUBSCRIBE k")
"""Commands on the channel of changed jobs."""

WITHOUT_KEY = ("PING", "EVALSHA 0 0", "SCRIPT LOAD 0", "MULTI", "EXEC", "SCAN 0")

# ARGV: commands, their parts separated by spaces. Returns the forbidden ones; none on a server without this check.
_FORBIDDEN = """
local found = {}
for _, command in ipairs(redis.acl_check_cmd and ARGV or {}) do
  local parts = {}
  for part in string.gmatch(command, '%S+') do parts[#parts + 1] = part end
  if not redis.acl_check_cmd(unpack(parts)) then found[#found + 1] = command end
end
return found
"""


def check_permissions(client: Any, prefix: str) -> None:
    """Check that the access rules of the server allow its user all that Pliant needs.

    Raises
    ------
    StoreForbidden
        They forbid some of it; the message names all of that.
    """
    groups = {
        f"the keys {prefix}:*": _with_key((*ON_BOTH, *ON_OWN), f"{prefix}:x"),
        "the keys rq:*": _with_key((*ON_BOTH, *ON_RQ), "rq:x"),
        f"the channel {prefix}:changes": _with_key(ON_CHANNEL, f"{prefix}:changes"),
        "": list(WITHOUT_KEY),
    }
    wanted = [command for group in groups.values() for command in group]
    forbidden = set(client.register_script(_FORBIDDEN)(args=wanted))
    if not forbidden:
        return
    subjects = [subject for subject, group in groups.items() if subject and forbidden.issuperset(group)]
    rest = [command for subject, group in groups.items() if subject not in subjects for command in group]
    names = dict.fromkeys(name_of(command) for command in rest if command in forbidden)
    commands = [f"the command{'' if len(names) == 1 else 's'} {', '.join(names)}"] if names else []
    raise StoreForbidden(" and ".join([*subjects, *commands]))


def name_of(command: str) -> str:
    """Return the name of a command with arguments."""
    return "SCRIPT LOAD" if command.startswith("SCRIPT LOAD") else command.partition(" ")[0]


def _with_key(commands: tuple[str, ...], key: str) -> list[str]:
    return [" ".join(key if part == "k" else part for part in command.split()) for command in commands]

"""Connections to Redis, and the translation of their errors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import redis
from pliant.worker.errors import JOB_STORE, InvalidSetting, StoreForbidden, StoreUnavailable
from pliant.worker.store.calls import SilentServer
from pliant.worker.store.permissions import check_permissions
from redis.backoff import ExponentialWithJitterBackoff
from redis.client import Pipeline
from redis.retry import Retry

CONNECT_WITHIN = 3.0
"""Seconds to open a connection."""

ANSWER_WITHIN = 7.0
"""Maximum seconds of a command. While Redis hangs, a request ends with 503 after this and `CONNECT_WITHIN`, 10 s in total."""

BLOCK_WITHIN = 30.0
"""The same for blocking commands, with which workers wait for deliveries."""


_SILENCE: dict[str, SilentServer] = {}
"""State of each server that this process has a client for, by URL."""


class _Client(redis.Redis):
    """Sends commands and pipelines only while the server answers. Subscriptions are not counted, because they wait for a long time."""

    server: SilentServer

    def execute_command(self, *command: Any, **options: Any) -> Any:
        with self.server.call():
            return super().execute_command(*command, **options)  # type: ignore[no-untyped-call]

    def pipeline(self, transaction: bool = True, shard_hint: Any = None) -> _Pipeline:
        pipe = _Pipeline(self.connection_pool, self.response_callbacks, transaction, shard_hint)
        pipe.server = self.server
        return pipe


class _Pipeline(Pipeline):
    server: SilentServer

    def execute(self, raise_on_error: bool = True) -> list[Any]:
        with self.server.call():
            return super().execute(raise_on_error)


def connect(url: str, *, decode: bool, retries: int = 3, answer_within: float | None = None) -> redis.Redis:
    """Return a client that connects on first use. Its replies are text if `decode` is True, else bytes, which RQ needs.

    After a broken connection it retries with growing pauses of up to 0.5 s. Changes of records are compare-and-set or idempotent, so a
    retry after a lost reply is harmless. Lines of a log may appear twice, and a webhook that was leased unnoticed is sent when the lease
    ends. Timeouts are not retried, since that would multiply the wait. `answer_within` is the time limit of a command, seconds; None:
    `ANSWER_WITHIN`, and `SilentServer` limits the commands sent to a silent server.

    Raises
    ------
    InvalidSetting
        The URL is malformed; the message does not show it, because it may hold a password.
    """
    seconds = ANSWER_WITHIN if answer_within is None else answer_within
    try:
        client = (redis.Redis if answer_within is not None else _Client).from_url(
            url,
            decode_responses=decode,
            socket_connect_timeout=min(CONNECT_WITHIN, seconds),
            socket_timeout=seconds,
            health_check_interval=15,
            retry=Retry(ExponentialWithJitterBackoff(base=0.05, cap=0.5), retries, (redis.ConnectionError,)),
        )
        pool = client.connection_pool
        pool.connection_class(**pool.connection_kwargs)  # refuses unknown parameters in the query of the URL
    except (ValueError, TypeError, redis.RedisError):
        raise InvalidSetting(
            "PLIANT_REDIS_URL", expected="a URL redis://, rediss:// or unix://", got="another text",
            hint="Percent-encode special characters of the password, and check the parameters after `?`.",
        ) from None  # fmt: skip
    if isinstance(client, _Client):
        client.server = _SILENCE.setdefault(url, SilentServer())
    return client


def check_server(url: str, *, queue: str) -> str:
    """Check the password in the URL and what its user may do for an installation; return the server's `maxmemory-policy`.

    It is empty if it is not readable.

    Raises
    ------
    StoreUnavailable
        The server does not answer or rejects the password.
    InvalidSetting
        The URL is malformed.
    """
    client = connect(url, decode=True, retries=0, answer_within=3.0)
    try:
        with reachable():
            check_permissions(client, queue)
            try:
                found: dict[str, str] = client.config_get("maxmemory-policy")  # type: ignore[assignment]
            except redis.ResponseError:  # managed servers hide their configuration
                return ""
            return found.get("maxmemory-policy", "")
    except redis.ResponseError as error:  # for example of a server that runs no scripts
        raise StoreUnavailable(JOB_STORE, reason=str(error)[:200]) from error
    finally:
        client.close()


def ping(url: str) -> None:
    """Check that the server answers and accepts the password in the URL; what its user may do is not checked.

    Raises
    ------
    StoreUnavailable
        The server does not answer or rejects the password.
    InvalidSetting
        The URL is malformed.
    """
    client = connect(url, decode=True, retries=0, answer_within=CONNECT_WITHIN)
    try:
        with reachable(), suppress(redis.exceptions.NoPermissionError):
            client.ping()
    finally:
        client.close()


@contextmanager
def reachable() -> Iterator[None]:
    """Translate connection failures to `StoreUnavailable`; errors of commands pass through."""
    try:
        yield
    except redis.AuthenticationError as error:
        raise StoreUnavailable(JOB_STORE, reason="it refuses the password") from error
    except redis.InvalidResponse as error:
        raise StoreUnavailable(JOB_STORE, reason="another program than Redis answers") from error
    except (redis.ConnectionError, redis.TimeoutError, redis.exceptions.ClusterDownError) as error:
        raise StoreUnavailable(JOB_STORE, reason=_reason(error)) from error
    except redis.OutOfMemoryError as error:
        raise StoreUnavailable(JOB_STORE, reason="its memory limit is reached") from error
    except redis.exceptions.NoPermissionError as error:
        raise StoreForbidden(_forbidden(str(error))) from error
    except redis.ResponseError as error:
        if _IN_SCRIPT in str(error):
            raise StoreForbidden(_forbidden(str(error))) from error
        if not str(error).startswith(("MISCONF", "LOADING", "READONLY")):
            raise
        raise StoreUnavailable(JOB_STORE, reason=str(error)[:200]) from error


_IN_SCRIPT = "ACL failure in script"
"""Part of the message about a command that a script may not run; older servers do not give it the code of a missing permission."""


def _forbidden(message: str) -> str:
    """Return what the server forbids, by its message about a missing permission; the name of the user is not repeated."""
    command = re.search(r"'([a-z|_-]+)' (?:sub)?command", message)
    if command is not None:
        return f"the command {command[1].upper().replace('|', ' ')}"
    if "channel" in message:
        return "a channel"
    return "a key" if "key" in message else "a command"


def _reason(error: redis.RedisError) -> str:
    """Return what the operating system or OpenSSL says, without the address; the type of the error if they say nothing."""
    cause = error.__cause__ or error.__context__
    return (cause.strerror if isinstance(cause, OSError) else None) or type(error).__name__

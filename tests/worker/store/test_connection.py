"""Faults of the store's server become one error; errors of commands pass through unchanged."""

from __future__ import annotations

import pickle
import ssl

import pytest
import redis
from pliant.worker.errors import InvalidSetting, StoreForbidden, StoreUnavailable
from pliant.worker.store.connection import check_server, connect, reachable


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (redis.AuthenticationError("WRONGPASS"), "it refuses the password"),
        (redis.ConnectionError("refused"), "ConnectionError"),
        (redis.TimeoutError("late"), "TimeoutError"),
        (redis.InvalidResponse("HTTP/1.1 400"), "another program than Redis answers"),
        (redis.OutOfMemoryError("OOM"), "its memory limit is reached"),
        (redis.ResponseError("MISCONF cannot persist"), "MISCONF cannot persist"),
        (redis.ResponseError("LOADING the dataset"), "LOADING the dataset"),
    ],
)
def test_a_server_that_cannot_serve_is_unavailable(fault: redis.RedisError, reason: str) -> None:
    with pytest.raises(StoreUnavailable, match=reason), reachable():
        raise fault


@pytest.mark.parametrize(
    ("fault", "forbidden"),
    [
        (redis.exceptions.NoPermissionError("User p has no permissions to run the 'get' command"), "the command GET"),
        (redis.exceptions.NoPermissionError("User p has no permissions to run the 'script|load' command"), "the command SCRIPT LOAD"),
        (redis.exceptions.NoPermissionError("No permissions to access a key"), "a key"),
        (redis.exceptions.NoPermissionError("No permissions to access a channel"), "a channel"),
        (redis.exceptions.NoPermissionError("in other words"), "a command"),
        (redis.ResponseError("ACL failure in script: User p has no permissions to run the 'hset' command"), "the command HSET"),
    ],
)  # fmt: skip
def test_a_missing_permission_is_named(fault: redis.RedisError, forbidden: str) -> None:
    with pytest.raises(StoreForbidden) as caught, reachable():
        raise fault
    assert str(caught.value) == (
        f"The job store is unavailable (its access rules forbid {forbidden}). No data was lost; the operator must grant the permission."
    )
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_the_reason_is_that_of_the_system_without_the_address() -> None:
    """For example a refused certificate, which was only called a ConnectionError."""
    fault = redis.ConnectionError("Error 1 connecting to redis.internal:6379")
    fault.__cause__ = ssl.SSLCertVerificationError(1, "certificate verify failed")
    with (
        pytest.raises(StoreUnavailable, match=r"^The job store is unavailable \(certificate verify failed\)"),
        reachable(),
    ):
        raise fault


def test_command_errors_pass_through_unchanged() -> None:
    with pytest.raises(redis.ResponseError, match="WRONGTYPE"), reachable():
        raise redis.ResponseError("WRONGTYPE of a key")


@pytest.mark.parametrize(
    "url",
    [
        "http://host",
        "redis://:pass/word@host",
        "redis://host:many",
        "redis://host?unknown=1",
        "rediss://host?ssl_cert_reqs=some",
    ],
)
def test_a_malformed_url_is_an_invalid_setting_and_not_shown(url: str) -> None:
    for opened in (lambda: connect(url, decode=True), lambda: check_server(url, queue="pliant")):
        with pytest.raises(InvalidSetting, match=r"^PLIANT_REDIS_URL: expected a URL redis://") as caught:
            opened()
        assert "pass" not in str(caught.value).replace("password", "")

"""Faults of the store's server become one error; errors of commands pass through unchanged."""

from __future__ import annotations

import pytest
import redis
from pliant.worker.errors import StoreUnavailable
from pliant.worker.store.connection import reachable


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (redis.AuthenticationError("WRONGPASS"), "it refuses the password"),
        (redis.ConnectionError("refused"), "ConnectionError"),
        (redis.TimeoutError("late"), "TimeoutError"),
        (redis.OutOfMemoryError("OOM"), "its memory limit is reached"),
        (redis.ResponseError("MISCONF cannot persist"), "MISCONF cannot persist"),
        (redis.ResponseError("LOADING the dataset"), "LOADING the dataset"),
    ],
)
def test_a_server_that_cannot_serve_is_unavailable(fault: redis.RedisError, reason: str) -> None:
    with pytest.raises(StoreUnavailable, match=reason), reachable():
        raise fault


def test_command_errors_pass_through_unchanged() -> None:
    with pytest.raises(redis.ResponseError, match="WRONGTYPE"), reachable():
        raise redis.ResponseError("WRONGTYPE of a key")

"""Messages about a store that does not answer: with its address, and ever less often while it lasts."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import urlsplit

from pliant.worker.errors import JOB_STORE, StoreForbidden, StoreUnavailable

FIRST_PAUSE, LONGEST_PAUSE = 2.0, 60.0
"""Seconds between two messages about one outage; doubled each time."""


def address_of(url: str) -> str:
    """Return the scheme, host and port of a Redis URL, or the path of its socket, without user, password and database."""
    parts = urlsplit(url)
    if parts.scheme == "unix":
        return f"unix://{parts.path}"
    host = parts.hostname or "localhost"
    return f"{parts.scheme}://{f'[{host}]' if ':' in host else host}:{parts.port or 6379}"


def described(error: StoreUnavailable, redis_url: str) -> str:
    """Return the message of an error with the address of the store if that is Redis, for those who run Pliant.

    Users of the service do not see it: an address tells them nothing.
    """
    if error.what != JOB_STORE:
        return str(error)
    remedy = f" {error.remedy}" if isinstance(error, StoreForbidden) else ""
    return f"{JOB_STORE} at {address_of(redis_url)} is unavailable ({error.reason}).{remedy}"


@dataclass(slots=True, kw_only=True)
class Outage:
    """Reports the failed and successful calls of one repeated task as few messages."""

    redis_url: str
    tell: Callable[[str], None]
    clock: Callable[[], float] = time.monotonic
    _pause: float = 0.0
    """Seconds between the last message and the next; 0: there is no outage."""
    _told: float = 0.0

    def failed(self, error: StoreUnavailable) -> None:
        """Report the beginning of an outage, and that it lasts once the pause is over."""
        now = self.clock()
        if self._pause == 0:
            self._pause, self._told = FIRST_PAUSE, now
            self.tell(f"{described(error, self.redis_url)} Waiting until it answers.")
        elif now >= self._told + self._pause:
            self._pause, self._told = min(2 * self._pause, LONGEST_PAUSE), now
            self.tell(f"{described(error, self.redis_url)} Still waiting.")

    def answered(self) -> None:
        """Report the end of an outage, if there was one."""
        if self._pause > 0:
            self._pause = 0.0
            self.tell("The store answers again.")


def warn(logger: logging.Logger, prefix: str = "") -> Callable[[str], None]:
    """Return a function that logs a message as a warning."""
    return lambda message: logger.warning("%s%s", prefix, message)

"""When a call is retried, and when the client gives up."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import SupportsFloat

import httpx
from pliant.client.call import Call
from pliant.client.errors import (
    APIStatusError,
    BadArgument,
    PliantError,
    ServiceFailed,
    TooManyRequests,
    UnexpectedAnswer,
    Unreachable,
    WaitTimeout,
)
from pliant.client.multipart import OnBytes

TEMPORARY = frozenset({502, 503, 504})
"""Statuses of a temporarily unavailable service, or of a proxy in front of it."""

EARLY = 0.05
"""Seconds by which a timer of the network may end before the deadline that it was set for: several times a timer's resolution."""

OUT_OF_STEP = frozenset({"upload_offset_mismatch", "upload_busy", "upload_taken_over", "upload_complete"})
"""Codes after which the client reads the upload's offset again and continues from there."""

SUBMISSION = "the submission"
"""Operation after whose timeout a repeated call could make a second job."""

CALL_AGAIN = "Nothing was cancelled; call again, or use a longer timeout."
"""Advice after the timeout of any other operation."""

NOT_EXECUTED = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout, TooManyRequests)
"""Errors after which the service has certainly not executed the call."""


@dataclass(frozen=True, kw_only=True)
class Retry:
    """How long and how often a client retries. The defaults outlast a restart of the service.

    Pauses grow exponentially with full jitter. A `Retry-After` header takes precedence.
    """

    patience: float = 90.0
    """Give up after this long without success, seconds."""

    first_contact: float = 5.0
    """The same until the service has responded once, so that a wrong address fails quickly, seconds."""

    shortest_pause: float = 0.25
    """Upper bound of the first pause, seconds; it doubles with each further failure."""

    longest_pause: float = 10.0
    """Upper bound of every pause, seconds."""

    long_poll: float = 20.0
    """Longest time that `wait` lets the service delay one response, seconds."""

    poll_interval: float = 0.5
    """Pause between two requests for a job if the service does not delay responses, seconds."""

    clock: Callable[[], float] = time.monotonic
    """Returns seconds, from any origin."""

    jitter: Callable[[], float] = random.random
    """Returns a factor in [0, 1) for each pause, which spreads the retries of many clients."""

    def __post_init__(self) -> None:
        for name in ("patience", "first_contact", "shortest_pause", "longest_pause", "long_poll", "poll_interval"):
            if _seconds(getattr(self, name), name) < 0:
                raise BadArgument(f"{name}: expected at least 0 seconds, got {getattr(self, name)!r}.")


@dataclass(kw_only=True)
class Contact:
    """State that a client keeps between calls."""

    url: str
    """Address of the service."""
    made: bool = False
    """True once the service has responded."""
    follows: bool = True
    """Whether downloads may be redirected to the object store; False once a redirect failed."""


@dataclass(kw_only=True)
class Attempts:
    """The attempts of one operation: its deadline, consecutive failures and next pause."""

    retries: Retry
    contact: Contact
    timeout: float | None = None
    doing: str = "the call"
    """Name of the operation in the message of `WaitTimeout`."""

    failures: int = 0
    uncertain: bool = False
    """Whether the service may have executed a call whose answer was lost."""
    failing_since: float = field(default=math.nan)
    deadline: float = field(init=False)

    def __post_init__(self) -> None:
        if self.timeout is not None:
            self.timeout = _seconds(self.timeout, "timeout")
        self.deadline = math.inf if self.timeout is None else self.retries.clock() + self.timeout

    def remaining(self) -> float:
        """Return the seconds to the deadline; `math.inf` without one.

        Raises
        ------
        WaitTimeout
            The deadline has passed.
        """
        left = self.deadline - self.retries.clock()
        if left <= 0:
            raise self._passed()
        return left

    def _passed(self) -> WaitTimeout:
        """Return the error for a deadline that passed while nothing failed."""
        return WaitTimeout(f"The timeout of {self.timeout:g} s passed during {self.doing}. {self._advice}")

    @property
    def _advice(self) -> str:
        if self.doing == SUBMISSION:
            return (
                "The job may have been accepted: look for it in the list of jobs, or submit again with the same idempotency_key, "
                "which never makes a second job."
            )
        return CALL_AGAIN

    def bounding(self, on_bytes: OnBytes | None) -> OnBytes:
        """Return `on_bytes` as a callback that raises `WaitTimeout` once the deadline has passed, in the middle of a body."""

        def report(done: int, total: int) -> None:
            self.remaining()
            if on_bytes is not None:
                on_bytes(done, total)

        return report

    def answered(self) -> None:
        """Record that the service responded."""
        self.contact.made = True

    def succeeded(self) -> None:
        """Reset the count of failures."""
        self.failures = 0
        self.failing_since = math.nan

    def pause_after(self, fault: Exception) -> float:
        """Return the seconds to wait before the next attempt.

        Full jitter: uniform between 0 and a bound that doubles, unless the service sent `Retry-After`.

        Raises
        ------
        WaitTimeout
            The deadline would pass during the pause.
        Unreachable, APIStatusError
            No attempt succeeded within the time that `retries` allows.
        """
        now = self.retries.clock()
        self.uncertain = self.uncertain or not isinstance(fault, NOT_EXECUTED)
        if self.failures == 0 and isinstance(fault, httpx.TimeoutException) and now >= self.deadline - EARLY:
            raise self._passed() from fault  # every wait for the network ends at the deadline
        if self.failures == 0:
            self.failing_since = now
        bound = min(self.retries.longest_pause, self.retries.shortest_pause * 2.0 ** min(self.failures, 30))
        self.failures += 1
        pause = bound * self.retries.jitter()
        requested = fault.retry_after if isinstance(fault, APIStatusError) else None
        if requested is not None:
            pause = requested + self.retries.shortest_pause * self.retries.jitter()
        patience = self.retries.patience if self.contact.made else self.retries.first_contact
        if now + pause - self.failing_since > patience:
            raise self._final(fault) from fault
        if now + pause >= self.deadline:
            raise WaitTimeout(
                f"The timeout of {self.timeout:g} s passed during {self.doing}; the last error was: "
                f"{_words(fault)}. {self._advice}"
            ) from fault
        return pause

    def _final(self, fault: Exception) -> PliantError:
        """Return the error that the caller sees after the last attempt."""
        if isinstance(fault, PliantError):
            return fault
        advice = "Check the address, and that `pliant up` is running there."
        if _proxied(self.contact.url):
            advice += " Requests go to the proxy in HTTP_PROXY, HTTPS_PROXY or ALL_PROXY, unless NO_PROXY lists the service's host."
        return Unreachable(f"No answer from the service at {self.contact.url}: {_words(fault)}. {advice}")


def _words(fault: Exception) -> str:
    """Return the message of an error without the period at its end; some errors of connections have none, only a type."""
    return str(fault).rstrip(".") or type(fault).__name__


def _proxied(url: str) -> bool:
    """Return True if the environment names a proxy for an address, as httpx reads it."""
    from urllib.request import getproxies, proxy_bypass  # here, because it is not needed otherwise

    address = httpx.URL(url)
    return not getproxies().keys().isdisjoint((address.scheme, "all")) and not proxy_bypass(address.host)


def _seconds(given: object, name: str) -> float:
    """Return a time, which may be a number of NumPy, as a float."""
    try:
        seconds = float(given) if isinstance(given, SupportsFloat) and not isinstance(given, bool) else math.nan
    except (TypeError, ValueError):  # an array
        seconds = math.nan
    if math.isnan(seconds):
        raise BadArgument(f"{name}: expected seconds as a number, got {given!r}.")
    return seconds


def may_repeat(call: Call, fault: Exception) -> bool:
    """Return True if a call may be sent again after this error.

    A call that is neither idempotent nor has an Idempotency-Key is repeated only if it was certainly not executed:
    the connection was not established, or the service responded with 429.
    """
    if isinstance(fault, httpx.UnsupportedProtocol | httpx.LocalProtocolError):
        return False
    if isinstance(fault, NOT_EXECUTED):
        return True
    if not call.repeatable:
        return False
    if isinstance(fault, UnexpectedAnswer):
        return fault.status in TEMPORARY
    if isinstance(fault, ServiceFailed):
        return fault.status in TEMPORARY or fault.problem.retryable
    return isinstance(fault, httpx.TransportError)

"""When a call is repeated, and when it is given up."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import httpx
from pliant.client.errors import PliantError, Refused, ServiceFailed, TimeIsUp, TooManyRequests, Unreachable
from pliant.client.flow import Call

PASSING = frozenset({502, 503, 504})
"""Statuses of a service, or of the proxy before it, that is away for a moment."""


@dataclass(frozen=True, kw_only=True)
class Policy:
    """How patient a client is. The defaults outlast a restart of the service."""

    patience: float = 90.0
    """Give up when nothing has worked for this long, seconds."""

    first_contact: float = 5.0
    """The same before the first answer ever: a wrong address is told soon, seconds."""

    shortest_pause: float = 0.25
    """Upper bound of the first pause, seconds; each further one may be twice as long."""

    longest_pause: float = 10.0
    """Upper bound of every pause, seconds."""

    long_poll: float = 20.0
    """How long the service is asked to hold an answer back while nothing is new, seconds."""

    poll_interval: float = 0.5
    """Pause between two looks at a job where the service does not hold answers back, seconds."""

    clock: Callable[[], float] = time.monotonic
    """Seconds, from any origin."""

    chance: Callable[[], float] = random.random
    """Uniform in [0, 1): the jitter that keeps many clients from returning all at once."""


@dataclass(kw_only=True)
class Contact:
    """What a client remembers between its calls: whether the service ever answered."""

    made: bool = False


@dataclass(kw_only=True)
class Attempts:
    """The tries of one verb: its deadline, its failures in a row, its next pause."""

    policy: Policy
    contact: Contact
    timeout: float | None = None
    doing: str = "talking to the service"
    """What the caller wants, for the sentence of `TimeIsUp`."""

    failures: int = 0
    failing_since: float = field(default=math.nan)
    deadline: float = field(init=False)

    def __post_init__(self) -> None:
        self.deadline = math.inf if self.timeout is None else self.policy.clock() + self.timeout

    def remaining(self) -> float:
        """Seconds to the deadline; `math.inf` without one.

        Raises
        ------
        TimeIsUp
            It has passed.
        """
        left = self.deadline - self.policy.clock()
        if left <= 0:
            raise TimeIsUp(
                f"{self.timeout:g} s were not enough for {self.doing}. "
                "Nothing was cancelled; call again, or give a longer timeout."
            )
        return left

    def answered(self) -> None:
        """Note that the service answered."""
        self.contact.made = True

    def succeeded(self) -> None:
        """Note that something worked: the count of failures starts afresh."""
        self.failures = 0
        self.failing_since = math.nan

    def pause_after(self, fault: Exception) -> float:
        """Return the seconds to wait before the next try, or raise if there shall be none.

        Full jitter: uniform between 0 and a bound that doubles, unless the service named the time itself.

        Raises
        ------
        TimeIsUp, Unreachable, Refused
            Too late, or too long without success.
        """
        now = self.policy.clock()
        if self.failures == 0:
            self.failing_since = now
        bound = min(self.policy.longest_pause, self.policy.shortest_pause * 2.0 ** min(self.failures, 30))
        self.failures += 1
        pause = bound * self.policy.chance()
        asked = fault.retry_after if isinstance(fault, Refused) else None
        if asked is not None:
            pause = asked + self.policy.shortest_pause * self.policy.chance()
        patience = self.policy.patience if self.contact.made else self.policy.first_contact
        if now + pause - self.failing_since > patience:
            raise self.final(fault) from fault
        if now + pause >= self.deadline:
            raise TimeIsUp(
                f"{self.timeout:g} s were not enough for {self.doing}; the last fault was: {fault or type(fault).__name__}. "
                "Call again, or give a longer timeout."
            ) from fault
        return pause

    def final(self, fault: Exception) -> PliantError:
        """Turn the last of many faults into what the caller sees."""
        if isinstance(fault, PliantError):
            return fault
        return Unreachable(
            f"No answer from the service: {str(fault) or type(fault).__name__}. "
            "Check the address, and that `pliant up` is running there."
        )


def may_repeat(call: Call, fault: Exception) -> bool:
    """Tell whether a call may be sent again after this fault.

    A call that is not idempotent and has no Idempotency-Key is repeated only if it cannot have been carried out:
    no connection came about, or the service turned it away for now.
    """
    if isinstance(fault, httpx.UnsupportedProtocol | httpx.LocalProtocolError):
        return False
    if isinstance(fault, httpx.ConnectError | httpx.ConnectTimeout | httpx.PoolTimeout | TooManyRequests):
        return True
    if not call.repeatable:
        return False
    if isinstance(fault, ServiceFailed):
        return fault.status in PASSING or fault.problem.retryable
    return isinstance(fault, httpx.TransportError)

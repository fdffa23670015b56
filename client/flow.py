"""What a conversation with the service is made of, for the synchronous and the asynchronous client alike.

A conversation ("flow") is a generator that yields what it wants done (open a call, pull the next bytes, pause …)
and is sent what came of it. It does no input or output itself: `pliant.client.client` and `pliant.client.async_client`
each drive flows in a few lines. So retries, deadlines and resumption are decided in one place, and tested without a network.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pliant.client.multipart import Form, Rest

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Call:
    """One request, as data: it can be sent as often as needed."""

    method: str
    path: str
    """From the service's address on, e.g. ``/v1/jobs``."""
    params: Mapping[str, str | list[str]] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    form: Form | None = None
    """Multipart body; its files are opened anew for every sending."""
    body: Rest | None = None
    """Raw body; likewise."""
    changes_nothing: bool = False
    """A POST that only asks a question."""

    @property
    def repeatable(self) -> bool:
        """True if sending it twice has the effect of sending it once."""
        safe = self.changes_nothing or self.method in ("GET", "HEAD", "PUT", "DELETE")
        return safe or "Idempotency-Key" in self.headers


@dataclass(frozen=True)
class Head:
    """The beginning of an answer."""

    status: int
    headers: Mapping[str, str]
    """Looked up without regard to case."""


@dataclass(frozen=True)
class Open:
    """Send the call and give its `Head`; an earlier answer is closed."""

    call: Call
    timeout: float
    """Upper bound for each network operation, seconds; may be infinite."""


@dataclass(frozen=True)
class Pull:
    """Give the next bytes of the open answer; none at its end."""


@dataclass(frozen=True)
class Pause:
    """Wait."""

    seconds: float


@dataclass(frozen=True)
class Do:
    """Call the function where it may take its time (the asynchronous client uses a thread), and give what it returns."""

    function: Callable[[], Any]


@dataclass(frozen=True)
class Emit:
    """Hand a value to whoever iterates over the flow."""

    value: Any


Wish = Open | Pull | Pause | Do | Emit
Flow = Generator[Wish, Any, T]

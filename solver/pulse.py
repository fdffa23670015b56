"""Progress reports from inside long units of work, and requests to stop them.

Linear algebra calls `pulse()` between steps, so that the monitor of the solve can report again if it has been silent. The receiver is a
context variable, like the limit of `threads`, because passing it through the linear algebra would add a parameter to every function.
Threads that `over_ranges` starts have no receiver; reports come only from the caller's thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

ShouldStop = Callable[[], bool]
"""Called between units of work: counts them, and returns True to stop."""

_RECEIVER: ContextVar[Callable[[], None] | None] = ContextVar("pulse", default=None)


def never() -> bool:
    """Return False: work that nobody asks to stop."""
    return False


@contextmanager
def pulses_to(receive: Callable[[], None]) -> Iterator[None]:
    """Let `pulse` call `receive` inside the `with` block."""
    before = _RECEIVER.set(receive)
    try:
        yield
    finally:
        _RECEIVER.reset(before)


def pulse() -> None:
    """Notify the receiver, if there is one, that the computation continues."""
    receive = _RECEIVER.get()
    if receive is not None:
        receive()

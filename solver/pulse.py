"""Reports from inside computations that are too long for one unit of work.

Linear algebra calls `pulse()` between pieces of work, and the monitor of the solve reports its progress again if it has been silent. The
receiver is a context variable, like the limit of `threads`: passing it through every function of the linear algebra would add a parameter
to all of them that none uses. Threads that `over_ranges` starts have no receiver, so reports come from the thread of the caller only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_RECEIVER: ContextVar[Callable[[], None] | None] = ContextVar("pulse", default=None)


@contextmanager
def pulses_to(receive: Callable[[], None]) -> Iterator[None]:
    """Have `pulse` call `receive` inside the `with` block."""
    before = _RECEIVER.set(receive)
    try:
        yield
    finally:
        _RECEIVER.reset(before)


def pulse() -> None:
    """Let the receiver, if there is one, report that the computation continues."""
    receive = _RECEIVER.get()
    if receive is not None:
        receive()

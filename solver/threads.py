"""Frames in parallel: NumPy and SciPy release the interpreter lock, so plain threads are enough."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar

SMALLEST = 200_000
"""Numbers a thread should have to work on, at least: below, starting it costs more than it saves."""

_LIMIT: ContextVar[int | None] = ContextVar("threads", default=None)


@contextmanager
def threads_limited(count: int | None) -> Iterator[None]:
    """Let solves inside the `with` block start at most `count` threads; None leaves it to the cores there are.

    The limit belongs to the calling thread (or task), so that two solves in one process can have different ones. It does not
    reach the threads of the linear-algebra library, which reads its own variables when it is loaded.

    Raises
    ------
    ValueError
        `count` is below 1.
    """
    if count is not None and count < 1:
        raise ValueError(f"expected at least 1 thread, got {count}; None uses every core that the process may use")
    before = _LIMIT.set(count)
    try:
        yield
    finally:
        _LIMIT.reset(before)


def available_cores() -> int:
    """Return how many threads a solve may use: the cores the process may run on, or fewer if `threads_limited` says so."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = _LIMIT.get()
    return max(1, cores if limit is None else min(cores, limit))


def over_ranges(work: Callable[[int, int], None], count: int, *, smallest: int = 1) -> None:
    """Call `work(start, stop)` on contiguous ranges that cover 0 … count, one range a core.

    Every index is worked on by the same arithmetic whatever the number of cores, so results do not depend on it as long as
    `work` writes to its own range alone.
    """
    cores = min(available_cores(), max(count // smallest, 1))
    if cores == 1:
        work(0, count)
        return
    cuts = [count * i // cores for i in range(cores + 1)]
    with ThreadPoolExecutor(cores) as pool:
        for done in [pool.submit(work, a, b) for a, b in itertools.pairwise(cuts)]:
            done.result()

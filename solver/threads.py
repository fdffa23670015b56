"""Threads over frames or points: NumPy and SciPy release the interpreter lock."""

from __future__ import annotations

import itertools
import operator
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar

from pliant.solver.pulse import pulse

SMALLEST = 200_000
"""Minimum number of array elements per thread; with fewer, starting the thread costs more than it saves."""

_LIMIT: ContextVar[int | None] = ContextVar("threads", default=None)


@contextmanager
def threads_limited(count: int | None) -> Iterator[None]:
    """Limit solves inside the `with` block to `count` threads; None uses all available cores.

    The limit applies to the calling thread or task, so two solves in one process can have different limits. It does not
    affect the threads of BLAS, which reads its own environment variables when it is loaded.

    Raises
    ------
    TypeError
        `count` is not a whole number.
    ValueError
        `count` is below 1.
    """
    if count is not None and operator.index(count) < 1:
        raise ValueError(f"expected at least 1 thread, got {count}; None uses every core that the process may use")
    before = _LIMIT.set(count)
    try:
        yield
    finally:
        _LIMIT.reset(before)


def available_cores() -> int:
    """Return the number of threads for a solve: the cores available to the process, at most the limit of `threads_limited`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = _LIMIT.get()
    return max(1, cores if limit is None else min(cores, limit))


def over_ranges(work: Callable[[int, int], None], count: int, *, smallest: int = 1) -> None:
    """Call `work(start, stop)` on contiguous ranges that cover [0, count), one per core, with at least `smallest` indices each.

    Results do not depend on the number of cores if `work` treats indices independently and writes only to its own range.
    """
    pulse()
    cores = min(available_cores(), max(count // smallest, 1))
    if cores == 1:
        work(0, count)
        return
    cuts = [count * i // cores for i in range(cores + 1)]
    with ThreadPoolExecutor(cores) as pool:
        for done in [pool.submit(work, a, b) for a, b in itertools.pairwise(cuts)]:
            done.result()

"""Threads over frames or points: NumPy and SciPy release the interpreter lock.

The solver's matrices are small and factored thousands of times. Dividing each over threads, as OpenBLAS does by default, costs more than it
saves (`python -m benchmarks.speed threads`), and where other programs run, its threads wait for each other. So BLAS runs in one thread
inside a solve, and the solver divides large work itself.
"""

from __future__ import annotations

import itertools
import operator
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Lock
from typing import TYPE_CHECKING

from pliant.solver.pulse import pulse

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

SMALLEST = 200_000
"""Minimum number of array elements per thread; with fewer, starting the thread costs more than it saves."""

_LIMIT: ContextVar[int | None] = ContextVar("threads", default=None)


@contextmanager
def threads_limited(count: int | None) -> Iterator[None]:
    """Limit solves inside the `with` block to `count` threads; None uses all available cores.

    The limit applies to the calling thread or task, so two solves in one process can have different limits. BLAS always runs in one thread
    inside a solve.

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


def _unchanged() -> None:
    """Restore nothing."""


def _release(libraries: ThreadpoolController) -> None:
    """Let every thread set the number of threads: in threadpoolctl 3.8 only the first one to set it can."""
    for library in libraries.lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)


def _limit_to_one(libraries: ThreadpoolController) -> Callable[[], None]:
    """Limit the libraries to one thread; return a function that restores their numbers of threads, from whichever thread calls it."""
    _release(libraries)
    limit = libraries.limit(limits=1)

    def restore() -> None:
        _release(libraries)
        limit.restore_original_limits()
        _release(libraries)

    return restore


class _SerialBlas:
    """Limits BLAS to one thread while at least one solve of the process runs, in whatever order they start and end."""

    def __init__(self) -> None:
        self._lock, self._running = Lock(), 0
        self._restore: Callable[[], None] = _unchanged

    def enter(self) -> None:
        from threadpoolctl import ThreadpoolController  # processes that solve nothing need not load it

        with self._lock:
            if self._running == 0:
                libraries = ThreadpoolController().select(user_api="blas")
                # Where it is 1 already, it is not set: in a forked process with a memory limit, OpenBLAS does not return from that.
                several = any(library["num_threads"] != 1 for library in libraries.info())
                self._restore = _limit_to_one(libraries) if several else _unchanged
            self._running += 1

    def leave(self) -> None:
        with self._lock:
            self._running -= 1
            if self._running == 0:
                self._restore()


_SERIAL_BLAS = _SerialBlas()


@contextmanager
def serial_blas() -> Iterator[None]:
    """Run BLAS in one thread inside the `with` block, in all threads of the process; then restore its number of threads."""
    _SERIAL_BLAS.enter()
    try:
        yield
    finally:
        _SERIAL_BLAS.leave()

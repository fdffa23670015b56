"""Frames in parallel: NumPy and SciPy release the interpreter lock, so plain threads are enough."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def available_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(len(os.sched_getaffinity(0)), 1)
    return os.cpu_count() or 1


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

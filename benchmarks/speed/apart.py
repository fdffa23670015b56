"""Run a measurement in a separate process, so that its peak memory is its own and running out of memory ends nothing else."""

from __future__ import annotations

import multiprocessing
import os
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

STATUS = Path("/proc/self/status")


@dataclass(frozen=True, slots=True)
class Measured:
    """Resources used by one process."""

    value: Any
    """What the function returned; None if it ran out of memory."""

    seconds: float
    cpu_seconds: float
    """CPU time of all threads, which stays comparable when other work shares the machine."""

    peak: int
    """Largest resident memory, bytes, libraries included."""

    growth: int
    """Increase of the peak over the resident memory at `Stopwatch.start`, bytes."""

    load: float
    """Load average at the end; above the number of cores, wall time means little."""


class Stopwatch:
    """Passed to the measured function; work before `start` (reading, corrupting) does not count."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        self.began, self.cpu, self.resident = time.perf_counter(), time.process_time(), memory("VmRSS")

    def stop(self, value: Any) -> Measured:
        seconds, cpu, peak = time.perf_counter() - self.began, time.process_time() - self.cpu, memory("VmHWM")
        return Measured(value, seconds, cpu, peak, peak - self.resident, os.getloadavg()[0])


def memory(name: str) -> int:
    """Return an entry of `/proc/self/status` in bytes: `VmRSS` (current) or `VmHWM` (peak)."""
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
    return int(lines[name].split()[0]) * 1024


def apart(work: Callable[..., Any], *arguments: Any, limit: int | None = None) -> Measured | None:
    """Call `work(stopwatch, *arguments)`, importable by name, in a new process limited to `limit` bytes; return None if it runs out of
    memory.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            return pool.submit(_measure, work, arguments, limit).result()
        except (MemoryError, BrokenProcessPool):
            return None


def _measure(work: Callable[..., Any], arguments: tuple[Any, ...], limit: int | None) -> Measured:
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    watch = Stopwatch()
    return watch.stop(work(watch, *arguments))

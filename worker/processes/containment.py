"""What contains a process: the number of its threads, its end with the parent process, and the out-of-memory killer."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path

from pliant.worker.control_group import group_files

NUMERICAL_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Environment variables for the thread counts of numerical libraries. Jobs set them to 1: the solver has its own threads, and BLAS
threads busy-wait, which slows down all processes on a loaded machine (`benchmarks/README.md`)."""

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def die_with_parent(parent: int, *, how: signal.Signals) -> None:
    """Make the kernel signal this process when its parent ends (Linux; elsewhere a job process polls its parent's id).

    `parent` is the parent's process id, taken before the fork, because the parent may already have ended.
    """
    if _libc is not None:
        _libc.prctl(_PR_SET_PDEATHSIG, int(how), 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), how)


@dataclass(frozen=True, slots=True)
class OomKills:
    """Counts of out-of-memory kills, in this process's control group and on the machine."""

    group: int
    machine: int

    @classmethod
    def now(cls) -> OomKills:
        """Read the kernel's counters; 0 where they do not exist."""
        own = [*group_files("memory.events")[:1], Path("/sys/fs/cgroup/memory/memory.oom_control")]  # cgroup v2 and v1
        return cls(sum(_counter(file, "oom_kill") for file in own), _counter(Path("/proc/vmstat"), "oom_kill"))

    def since(self, before: OomKills) -> bool:
        """Return whether the kernel killed a process since an earlier reading."""
        return self.group > before.group or self.machine > before.machine


def _counter(file: Path, name: str) -> int:
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return 0
    for line in lines:
        key, _, value = line.partition(" ")
        if key == name:
            return int(value)
    return 0

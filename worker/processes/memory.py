"""Memory of this machine: for one job, and for the workers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pliant.worker.control_group import group_files
from pliant.worker.environment import variable_of
from pliant.worker.errors import InvalidSetting
from pliant.worker.settings import Settings

LIBRARIES = 400 << 20
"""Bytes of address space that libraries reserve without being resident: the difference between the address space, which
`PLIANT_MEMORY_LIMIT` bounds, and the memory that a job needs."""

IDLE_WORKER = 70 << 20
"""Bytes that a worker without a job shares with no other process. It bounds the number of workers; measured: `Private_Dirty` of
`smaps_rollup` once all modules of a job are imported, 70.2 MiB with Python 3.11 on x86-64."""


def memory_there(groups: Sequence[Path] | None = None) -> int:
    """Return the bytes there are: the lowest of the machine's and the limits of container and systemd unit; 0 if unknown.

    The limits are in the files `groups`: bytes, or `max`.
    """
    limits = group_files("memory.max") if groups is None else groups
    return min((size for size in (_physical(), *map(_group, limits)) if size > 0), default=0)


def check_workers(settings: Settings, *, groups: Sequence[Path] | None = None) -> None:
    """Check that all workers fit into the memory while they are idle; one worker is always accepted.

    Raises
    ------
    InvalidSetting
        There are more.
    """
    there = memory_there(groups)
    most = max(1, there // IDLE_WORKER)
    if there > 0 and settings.workers > most:
        raise InvalidSetting(
            variable_of("workers"),
            expected=f"at most {most}, since {there / 1e9:.1f} GB of memory hold no more idle workers",
            got=str(settings.workers),
            hint="Lower it, also where it is given as --workers: one worker per usable core is usual, and each running job needs "
            "memory of its own.",
        )


def memory_for_a_job(settings: Settings, *, groups: Sequence[Path] | None = None) -> int:
    """Return the bytes for one job: the lower of its limit and its share of `memory_there`; 0 if unknown."""
    share = memory_there(groups) // settings.workers
    limit = max(0, settings.memory_limit - LIBRARIES)
    return min((size for size in (share, limit) if size > 0), default=0)


def _physical() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows has no `sysconf`
        return 0


def _group(file: Path) -> int:
    try:
        text = file.read_text().strip()
    except OSError:
        return 0
    return int(text) if text.isdigit() else 0

"""Memory available to one job on this machine."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pliant.worker.control_group import group_files
from pliant.worker.settings import Settings

LIBRARIES = 400 << 20
"""Bytes of address space that libraries reserve without being resident: the difference between the address space, which
`PLIANT_MEMORY_LIMIT` bounds, and the memory that a job needs."""


def memory_for_a_job(settings: Settings, *, groups: Sequence[Path] | None = None) -> int:
    """Return the bytes for one job: the lower of its limit and its share of the memory there is; 0 if unknown.

    That memory is the lowest of the machine's and the limits of container and systemd unit, in the files `groups`: bytes, or `max`.
    """
    limits = group_files("memory.max") if groups is None else groups
    there = [size for size in (_physical(), *map(_group, limits)) if size > 0]
    share = min(there) // settings.workers if there else 0
    limit = max(0, settings.memory_limit - LIBRARIES)
    return min((size for size in (share, limit) if size > 0), default=0)


def _physical() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return 0


def _group(file: Path) -> int:
    try:
        text = file.read_text().strip()
    except OSError:
        return 0
    return int(text) if text.isdigit() else 0

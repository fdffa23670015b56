"""Memory available to one job on this machine."""

from __future__ import annotations

import os
from pathlib import Path

from pliant.worker.settings import Settings

LIBRARIES = 400 << 20
"""Bytes of address space that libraries reserve without being resident: the difference between the address space, which
`PLIANT_MEMORY_LIMIT` bounds, and the memory that a job needs."""

GROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""File with a container's memory limit: bytes, or `max` (cgroup v2)."""


def memory_for_a_job(settings: Settings, *, group: Path = GROUP_LIMIT) -> int:
    """Return the bytes for one job: the lower of its limit and its share of the container's or machine's memory; 0 if unknown."""
    there = [size for size in (_physical(), _group(group)) if size > 0]
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

"""Peak resident memory of a process between two readings, and of its children. Linux."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


def forget_peak(pid: int) -> None:
    Path(f"/proc/{pid}/clear_refs").write_text("5")


def peak_of(pid: int) -> int:
    """Return the peak in bytes."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return 0


@dataclass
class Watched:
    own: int = 0
    children: int = 0
    """Largest of any child, bytes."""
    started: int = 0
    """Children seen."""


@contextmanager
def watched(pid: int, *, every: float = 0.003) -> Iterator[Watched]:
    """Poll a process and its descendants; a child's own high-water mark makes gaps harmless."""
    found, over, seen = Watched(), threading.Event(), set[int]()

    def look() -> None:
        while not over.wait(every):
            for child in descendants(pid):
                try:
                    found.children = max(found.children, peak_of(child))
                except (OSError, ProcessLookupError):
                    continue
                seen.add(child)

    forget_peak(pid)
    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield found
    finally:
        over.set()
        thread.join()
        found.started = len(seen)
        found.own = peak_of(pid)


def descendants(pid: int) -> list[int]:
    children: list[int] = []
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            children += [int(word) for word in (task / "children").read_text().split()]
    except OSError:
        return children
    return children + [each for child in children for each in descendants(child)]

"""One upload on the disk: a folder, what it holds, and its lock.

While it grows it holds `part`, whose size is the offset; when it is whole, `part` is renamed to `whole-SHA256`, and never written
again. So the one thing that tells a whole upload from half of one is an atomic rename, and a process that is killed leaves nothing
that has to be repaired.

Whoever writes to, removes or expires an upload holds a lock on its folder; the kernel gives it up with the process.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pliant.worker.errors import Conflict, UnknownUpload

PART, WHOLE, LENGTH = "part", "whole-", "length"


@contextmanager
def locked(folder: Path, *, make: bool, id: str) -> Iterator[None]:
    """Hold an upload's folder alone.

    Raises
    ------
    UnknownUpload
        There is none, and it is not to be made.
    Conflict
        Somebody else holds it.
    """
    descriptor = _lock(folder, make=make, id=id)
    try:
        yield
    finally:
        os.close(descriptor)


def _lock(folder: Path, *, make: bool, id: str) -> int:
    while True:
        if make:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:
            if make:
                continue
            raise UnknownUpload(id) from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # It may have been removed, and made anew, between the two calls; then the lock is of a folder without a name.
            if os.path.samestat(os.fstat(descriptor), folder.stat()):
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            sentence = f"Somebody else writes to upload {id!r} just now. Try again in a moment."
            raise Conflict("upload_busy", id=id, sentence=sentence) from None
        except FileNotFoundError:
            pass
        os.close(descriptor)


def content(folder: Path) -> Path | None:
    """Return the file that holds an upload's bytes, None if there is none."""
    for _ in range(2):  # between the two looks it may have become whole
        for path in folder.glob(f"{WHOLE}*"):
            return path
        if (folder / PART).exists():
            return folder / PART
    return None


def said_length(folder: Path) -> int | None:
    """Return how long the whole upload is, as was said when it began; None if nothing was."""
    file = folder / LENGTH
    return int(file.read_text()) if file.exists() else None

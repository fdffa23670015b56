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
from contextlib import contextmanager, suppress
from pathlib import Path

from pliant.worker.errors import Conflict, UnknownUpload

PART, WHOLE, LENGTH, RESERVED = "part", "whole-", "length", "reserved"
"""`reserved` exists while the upload is written to: the bytes set aside for it, locked by the writer."""


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


def reserve(folder: Path) -> int:
    """Open and lock the reservation of an upload that is being written; return its descriptor."""
    descriptor = os.open(folder / RESERVED, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    return descriptor


def taken(folder: Path) -> int:
    """Return the bytes of the quota that an upload takes: what it holds, or has reserved while it is written to."""
    file = content(folder)
    held = 0
    with suppress(FileNotFoundError):
        held = 0 if file is None else file.stat().st_size
    with suppress(FileNotFoundError, ValueError), (folder / RESERVED).open("rb") as reserved:
        try:
            fcntl.flock(reserved, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return max(held, int(reserved.read() or b"0"))
    return held


@contextmanager
def counting(directory: Path) -> Iterator[None]:
    """Hold the lock under which space is counted and reserved, so that two uploads cannot reserve the same bytes."""
    directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def declared_length(folder: Path) -> int | None:
    """Return the length of the whole upload as declared when it began; None if it was not."""
    file = folder / LENGTH
    return int(file.read_text()) if file.exists() else None

"""One upload on disk: a folder with its file and a lock.

An incomplete upload is the file `part`, whose size is the offset. A complete one is renamed to `whole-SHA256` and never written
again. The rename is atomic, so nothing has to be repaired after a process is killed.

Writing to, removing and expiring an upload require a lock on its folder, which the kernel releases when the process ends.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pliant.worker.errors import Conflict, UnknownUpload

PART, WHOLE, LENGTH, RESERVED = "part", "whole-", "length", "reserved"
"""Files of an upload. `RESERVED` exists while the upload is written: it holds the number of reserved bytes, locked by the writer."""


@contextmanager
def locked(folder: Path, *, make: bool, id: str) -> Iterator[None]:
    """Lock an upload's folder exclusively.

    Raises
    ------
    UnknownUpload
        The folder does not exist, and `make` is False.
    Conflict
        Another process holds the lock.
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
            # The folder may have been removed and created again between the two calls; the lock is then on a removed folder.
            if os.path.samestat(os.fstat(descriptor), folder.stat()):
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            sentence = f"Upload {id!r} is being written by another request. Try again in a moment."
            raise Conflict("upload_busy", id=id, sentence=sentence) from None
        except FileNotFoundError:
            pass
        os.close(descriptor)


def content(folder: Path) -> Path | None:
    """Return the file with an upload's bytes, None if there is none."""
    for _ in range(2):  # it may be completed, i.e. renamed, while the names are read
        with suppress(FileNotFoundError):
            found = [path for path in folder.iterdir() if path.name == PART or path.name.startswith(WHOLE)]
            if found:
                return max(found)
    return None


def reserve(folder: Path) -> int:
    """Open and lock the reservation of an upload that is being written; return its descriptor."""
    descriptor = os.open(folder / RESERVED, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    return descriptor


def taken(folder: Path) -> int:
    """Return the bytes of the quota that an upload uses: its size, or its reservation while it is written, if larger."""
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
    """Hold the lock for counting and reserving space, so that two uploads cannot reserve the same bytes."""
    directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def declared_length(folder: Path) -> int | None:
    """Return the declared length of the complete upload, None if it was not declared."""
    file = folder / LENGTH
    return int(file.read_text()) if file.exists() else None

"""An upload while it grows: bytes at the end of a file, their digest, and how many there may be."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from pliant.worker.errors import InvalidRequest, QuotaExceeded, UploadTooLarge
from pliant.worker.uploads.folder import LENGTH, PART, RESERVED, WHOLE, counting, reserve, taken

STEP = 16 << 20
"""Bytes that are reserved at a time for an upload whose length is not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Capacity:
    """How much one upload may take."""

    max_bytes: int
    """Size of the whole upload."""
    quota: int = 0
    """Bytes that everything stored may take together; 0: no quota."""
    used: int = 0
    """Bytes that the jobs take."""


@dataclass(slots=True, kw_only=True)
class Writer:
    """An upload while it grows, behind its lock; made by `Uploads.write`."""

    id: str
    folder: Path
    length: int | None
    """Bytes of the whole upload, where they are known."""
    capacity: Capacity
    offset: int = 0
    """Bytes that it holds."""
    _began: int = 0
    _reservation: int | None = None
    """Descriptor of the locked reservation."""
    _reserved: int = 0
    _file: BinaryIO | None = None
    _digest: hashlib._Hash = field(default_factory=hashlib.sha256)

    def open(self, offset: int) -> None:
        """Begin, or go on after what is there.

        Raises
        ------
        OSError
            ENOSPC: the disk has no room for the rest of it.
        """
        if self.capacity.quota > 0:
            self._reservation = reserve(self.folder)
        self._check(self.length or 0)
        if self.length is not None:
            if self.length - offset > shutil.disk_usage(self.folder).free:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            fresh = self.folder / f"{LENGTH}.new"
            fresh.write_text(str(self.length))
            fresh.replace(self.folder / LENGTH)
        elif offset == 0:
            (self.folder / LENGTH).unlink(missing_ok=True)
        part = self.folder / PART
        self._file = part.open("ab" if offset > 0 else "wb", buffering=0)
        self.offset = self._began = offset

    def write(self, piece: bytes) -> None:
        """Add bytes.

        Raises
        ------
        InvalidRequest
            They are more than the upload's length; what fitted is kept.
        UploadTooLarge
            The upload is larger than it may be; it is removed, since it can never become whole.
        QuotaExceeded
            Everything stored is as much as it may be; what fitted is kept.
        OSError
            The disk is full; what this request brought is given back to it, since others need the room.
        """
        assert self._file is not None
        if self.length is not None and self.offset + len(piece) > self.length:
            raise inconsistent(f"{self.length} bytes in all", "more")
        self._check(self.offset + len(piece))
        rest = memoryview(piece)
        try:
            while rest:
                count = self._file.write(rest)
                if self._began == 0:
                    self._digest.update(rest[:count])
                rest = rest[count:]
                self.offset += count
        except OSError:
            self._file.truncate(self._began)
            raise

    def finish(self, *, sha256: str | None) -> None:
        """Make the upload whole.

        Parameters
        ----------
        sha256 : str, optional
            What the sender says that it is.

        Raises
        ------
        InvalidRequest
            Bytes are missing; or they are not the sender's, and then the upload is removed.
        """
        if self.length is not None and self.offset != self.length:
            raise inconsistent(f"{self.length} bytes in all", str(self.offset))
        found = self._sha256()
        if sha256 is not None and sha256 != found:
            self.close()
            shutil.rmtree(self.folder)
            raise InvalidRequest(
                "digest_mismatch", field="Repr-Digest", expected=sha256, got=found,
                hint="The bytes changed on their way; the upload was removed, send it again.",
            )  # fmt: skip
        self.close()
        (self.folder / PART).rename(self.folder / f"{WHOLE}{found}")
        folder = os.open(self.folder, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def close(self) -> None:
        """Put what has arrived on the disk, and give back what was reserved beyond it."""
        if self._file is not None:
            os.fsync(self._file.fileno())
            self._file.close()
            self._file = None
        if self._reservation is not None:
            (self.folder / RESERVED).unlink(missing_ok=True)
            os.close(self._reservation)
            self._reservation = None

    def _sha256(self) -> str:
        """Return the digest of the whole. One that came in several requests is read once, here: not at each of them."""
        if self._began == 0:
            return self._digest.hexdigest()
        with (self.folder / PART).open("rb") as whole:
            return hashlib.file_digest(whole, "sha256").hexdigest()

    def _check(self, size: int) -> None:
        """Check that the upload may have so many bytes, and reserve them.

        Bytes are reserved before they are written, those of a declared length at once and others in steps, so that uploads which
        arrive at the same time cannot exceed the quota together.
        """
        capacity = self.capacity
        if size > capacity.max_bytes:
            self.close()
            shutil.rmtree(self.folder)
            raise UploadTooLarge(capacity.max_bytes, size)
        if self._reservation is None or size <= self._reserved:
            return
        uploads = self.folder.parent.parent
        with counting(uploads):
            others = sum(taken(each) for each in uploads.glob("*/*") if each != self.folder)
            free = capacity.quota - capacity.used - others
            if size > free:
                raise QuotaExceeded(used=capacity.used + others + self.offset, quota=capacity.quota)
            self._reserved = size if self.length is not None else min(size + STEP, free)
            os.pwrite(self._reservation, f"{self._reserved:<20}".encode(), 0)


def inconsistent(expected: str, got: str) -> InvalidRequest:
    """Return the error of an upload whose bytes do not fit its declared length."""
    return InvalidRequest(
        "inconsistent_upload_length", field="Upload-Length", expected=expected, got=got,
        hint="Send what is missing, or begin anew at Upload-Offset: 0.",
    )  # fmt: skip

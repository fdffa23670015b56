"""Write an upload: append bytes, update the digest, enforce the limits."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from pliant.schemas import digests
from pliant.worker.errors import Conflict, InvalidRequest, OffsetMismatch, QuotaExceeded, UnknownUpload, UploadTooLarge
from pliant.worker.uploads.folder import LENGTH, PART, RESERVED, WHOLE, counting, reserve, taken

RESERVED_AT_A_TIME = 16 << 20
"""Bytes reserved at a time for an upload of unknown length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Capacity:
    """Limits of one upload."""

    max_bytes: int
    """Maximum size of the complete upload, bytes."""
    quota: int = 0
    """Disk quota for jobs and uploads together, bytes; 0: no quota."""
    used: int = 0
    """Bytes used by the jobs."""


@dataclass(slots=True, kw_only=True)
class Writer:
    """An upload open for writing, under its lock; created by `Uploads.write`."""

    id: str
    folder: Path
    length: int | None
    """Bytes of the complete upload, if known."""
    capacity: Capacity
    offset: int = 0
    """Bytes received so far."""
    _began: int = 0
    _reservation: int | None = None
    """Descriptor of the locked reservation."""
    _reserved: int = 0
    _file: BinaryIO | None = None
    _digest: hashlib._Hash = field(default_factory=hashlib.sha256)

    def open(self, offset: int) -> None:
        """Start or resume after the existing bytes.

        Raises
        ------
        OSError
            ENOSPC: the remaining bytes do not fit on the disk.
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
        """Append bytes.

        Raises
        ------
        InvalidRequest
            The bytes exceed the upload's length; none of them is written, and earlier bytes are kept.
        UploadTooLarge
            The upload exceeds its maximum size; it is removed, since it can never be completed.
        QuotaExceeded
            The disk quota is reached; none of the bytes is written, and earlier bytes are kept.
        OSError
            The disk is full; the bytes of this request are removed to free the space.
        """
        if self.length is not None and self.offset + len(piece) > self.length:
            raise inconsistent(f"{self.length} bytes in all", "more")
        self._check(self.offset + len(piece))
        self._append(piece)

    def _append(self, piece: bytes) -> None:
        assert self._file is not None
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
        """Complete the upload; `sha256` is the digest that the sender expects.

        Raises
        ------
        InvalidRequest
            Bytes are missing; or the digest differs, and the upload is removed.
        """
        if self.length is not None and self.offset != self.length:
            raise inconsistent(f"{self.length} bytes in all", str(self.offset))
        found = self._sha256()
        if sha256 is not None and sha256 != found:
            self._discard()
            raise InvalidRequest(
                "digest_mismatch", field=digests.REPR_DIGEST, expected=sha256, got=found,
                hint="The bytes changed in transit; the upload was removed, send it again.",
            )  # fmt: skip
        self._complete(found)

    def _complete(self, found: str) -> None:
        """Mark the upload as complete, with its digest."""
        self.close()
        (self.folder / PART).rename(self.folder / f"{WHOLE}{found}")
        folder = os.open(self.folder, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def close(self) -> None:
        """Flush the received bytes to disk and release the unused reservation."""
        if self._file is not None:
            os.fsync(self._file.fileno())
            self._file.close()
            self._file = None
        if self._reservation is not None:
            (self.folder / RESERVED).unlink(missing_ok=True)
            os.close(self._reservation)
            self._reservation = None

    def _sha256(self) -> str:
        """Return the digest of the complete upload. After several requests the file is read once here, not in each of them."""
        if self._began == 0:
            return self._digest.hexdigest()
        return digests.sha256(self.folder / PART)

    def _check(self, size: int) -> None:
        """Check the limits for a size in bytes, and reserve it.

        Bytes are reserved before they are written, all at once for a declared length and otherwise in steps, so that
        concurrent uploads cannot exceed the quota together.
        """
        if size > self.capacity.max_bytes:
            self._discard()
            raise UploadTooLarge(self.capacity.max_bytes, size)
        self._reserve(size)

    def _discard(self) -> None:
        self.close()
        shutil.rmtree(self.folder)

    def _reserve(self, size: int) -> None:
        if self._reservation is None or size <= self._reserved:
            return
        uploads = self.folder.parent.parent
        with counting(uploads):
            others = sum(taken(each) for each in uploads.glob("*/*") if each != self.folder)
            self._reserved = self._share(size, others)
            os.pwrite(self._reservation, f"{self._reserved:<20}".encode(), 0)

    def _share(self, size: int, others: int) -> int:
        """Return the bytes to reserve for a size, while other uploads hold `others` bytes."""
        capacity = self.capacity
        free = capacity.quota - capacity.used - others
        if size > free:
            raise QuotaExceeded(
                used=capacity.used + others + self.offset, quota=capacity.quota, needed=size - self.offset
            )
        return size if self.length is not None else min(size + RESERVED_AT_A_TIME, free)


@dataclass(frozen=True, slots=True, kw_only=True)
class Held:
    """What is stored of an upload."""

    offset: int
    """Bytes."""
    length: int | None
    """Declared bytes of the complete upload."""
    complete: bool


def continued(id: str, held: Held | None, *, offset: int, length: int | None) -> int | None:
    """Return the length of an upload that a request writes to, in bytes, if any request has declared it; offset 0 begins it anew.

    Raises
    ------
    Conflict
        It is complete; `OffsetMismatch` if its size differs from `offset`.
    UnknownUpload
        Nothing is stored to continue.
    InvalidRequest
        The lengths contradict each other.
    """
    if held is not None and held.complete:
        raise Conflict("upload_complete", id=id, sentence=f"Upload {id!r} is complete. Use it, or delete it first.")
    if held is None or offset == 0:
        held = Held(offset=0, length=None, complete=False)
        if offset > 0:
            raise UnknownUpload(id)
    if offset != held.offset:
        raise OffsetMismatch(id, expected=held.offset, got=offset)
    return agreed_length(length, known=held.length, offset=offset)


def incomplete(id: str) -> Conflict:
    """Return the error for the use of an upload that is not complete."""
    sentence = f"Upload {id!r} is not complete yet: send the rest, from the offset that HEAD reports."
    return Conflict("upload_incomplete", id=id, sentence=sentence)


def agreed_length(given: int | None, *, known: int | None, offset: int) -> int | None:
    """Return the bytes of the complete upload, from this request or an earlier one; None if no request has declared them.

    Raises
    ------
    InvalidRequest
        The request declares another length than an earlier one, or fewer bytes than are held already.
    """
    if given is None:
        return known
    if known not in (None, given):
        raise inconsistent(f"{known} bytes, as declared in an earlier request", str(given))
    if given < offset:
        raise inconsistent(f"at least the {offset} bytes that are held already", str(given))
    return given


def inconsistent(expected: str, got: str) -> InvalidRequest:
    """Return the error for an upload that does not match its declared length."""
    return InvalidRequest(
        "inconsistent_upload_length", field="Upload-Length", expected=expected, got=got,
        hint="Send the missing bytes, or start again at Upload-Offset: 0.",
    )  # fmt: skip

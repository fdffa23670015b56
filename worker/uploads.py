"""Large inputs before there is a job: files that arrive over several requests, kept on the data volume until they expire.

An upload is a folder. While it grows it holds `part`, whose size is the offset; when it is whole, `part` is renamed to
`whole-SHA256`, and never written again. So the one thing that tells a whole upload from half of one is an atomic rename, a
process that is killed leaves nothing that has to be repaired, and a job can take its input only from a whole one.

Whoever writes to, removes or expires an upload holds a lock on its folder; the kernel gives it up with the process.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import BinaryIO

from pliant.client.schemas import Upload
from pliant.worker.checks import check_id, is_id
from pliant.worker.errors import (
    Conflict,
    InvalidRequest,
    OffsetMismatch,
    QuotaExceeded,
    TooManyUploads,
    UnknownUpload,
    UploadTooLarge,
)
from pliant.worker.settings import Settings

PART, WHOLE, LENGTH = "part", "whole-", "length"
MOST = 100
"""Uploads that one owner may have at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """How much one upload may still take."""

    max_bytes: int
    """Size of the whole upload."""
    quota: int = 0
    """Bytes that everything stored may take together; 0: no quota."""
    used: int = 0
    """Bytes that everything else takes now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Uploads:
    """The uploads of one owner, or of a service without owners."""

    directory: Path
    expiry: float
    """Seconds after its last byte or last use that an upload is removed; 0: never."""
    owner: str = ""

    @classmethod
    def open(cls, settings: Settings) -> Uploads:
        """Return the uploads of an installation; nothing is made before it is needed."""
        return cls(directory=settings.uploads, expiry=settings.upload_expiry)

    def of(self, owner: str) -> Uploads:
        """Return the same uploads as this owner sees them."""
        return replace(self, owner=owner)

    def get(self, id: str) -> Upload:
        """Return how far an upload is.

        Raises
        ------
        UnknownUpload
            There is none of that id.
        """
        folder = self._folder(id)
        file = _content(folder)
        try:
            if file is None:
                raise UnknownUpload(id)
            held, length = file.stat(), _length(folder)
        except FileNotFoundError:
            raise UnknownUpload(id) from None
        whole = file.name.startswith(WHOLE)
        return Upload(
            id=id,
            offset=held.st_size,
            length=held.st_size if whole else length,
            complete=whole,
            sha256=file.name.removeprefix(WHOLE) if whole else None,
            expires_at=None if self.expiry == 0 else _moment(held.st_mtime) + timedelta(seconds=self.expiry),
        )

    def find(self, id: str) -> Upload | None:
        """Return how far an upload is, None if there is none of that id."""
        with suppress(UnknownUpload):
            return self.get(id)
        return None

    def size(self, id: str) -> int:
        """Return the bytes that have arrived of an upload, 0 if there is none of that id."""
        there = self.find(id)
        return 0 if there is None else there.offset

    @contextmanager
    def write(self, id: str, *, offset: int, length: int | None, room: Room) -> Iterator[Writer]:
        """Go on with an upload, or begin it at 0: what an unfinished one of that id held is thrown away then.

        Parameters
        ----------
        offset : int
            Where the bytes that follow belong; must be what the upload holds.
        length : int, optional
            Bytes of the whole upload, where they are known.
        room : Room
            How large it may become.

        Raises
        ------
        Conflict
            The upload is whole already, or another process writes to it; `OffsetMismatch` if it is elsewhere.
        UnknownUpload, InvalidRequest, UploadTooLarge, QuotaExceeded, TooManyUploads
            See `pliant.worker.errors`.
        """
        if offset == 0:
            check_id(id)
        folder = self._folder(id)
        if offset == 0 and not folder.exists():
            self._check_number()
        with _locked(folder, make=offset == 0, id=id):
            file = _content(folder)
            if file is not None and file.name.startswith(WHOLE):
                raise Conflict(
                    "upload_complete", id=id, sentence=f"Upload {id!r} is whole. Use it, or delete it first."
                )
            if offset > 0 and file is None:
                raise UnknownUpload(id)
            held = file.stat().st_size if file is not None and offset > 0 else 0
            if offset != held:
                raise OffsetMismatch(id, expected=held, got=offset)
            known = _length(folder) if offset > 0 else None
            if length is not None and known not in (None, length):
                raise _inconsistent(f"{known} bytes, as was said at first", str(length))
            writer = Writer(id=id, folder=folder, length=length if length is not None else known, room=room)
            writer.open(offset)
            try:
                yield writer
            finally:
                writer.close()

    def take(self, id: str, to: Path) -> str:
        """Give a whole upload a second name, where neither deletion nor expiry reaches it, and return its SHA-256.

        Raises
        ------
        UnknownUpload
            There is none of that id.
        Conflict
            It is not whole yet.
        """
        file = _content(self._folder(id))
        if file is None:
            raise UnknownUpload(id)
        if not file.name.startswith(WHOLE):
            sentence = f"Upload {id!r} is not whole yet: send the rest of it, from the offset that HEAD tells."
            raise Conflict("upload_incomplete", id=id, sentence=sentence)
        try:
            os.utime(file)  # used: its time begins anew
            try:
                os.link(file, to)
            except FileNotFoundError:
                raise
            except OSError:  # a file system without links
                shutil.copyfile(file, to)
        except FileNotFoundError:
            raise UnknownUpload(id) from None
        return file.name.removeprefix(WHOLE)

    def delete(self, id: str) -> None:
        """Remove an upload, whole or not.

        Raises
        ------
        UnknownUpload
            There is none of that id.
        Conflict
            Another process writes to it.
        """
        folder = self._folder(id)
        with _locked(folder, make=False, id=id):
            shutil.rmtree(folder)

    def used(self) -> int:
        """Return the bytes that everybody's uploads take."""
        return sum(file.stat().st_size for file in self.directory.glob("*/*/*") if file.is_file())

    def expire(self, now: datetime) -> list[str]:
        """Remove everybody's uploads whose time is over and which nobody writes to; return their ids."""
        gone = []
        for folder in self.directory.glob("*/*") if self.expiry > 0 else ():
            with suppress(Conflict, UnknownUpload, FileNotFoundError), _locked(folder, make=False, id=folder.name):
                file = _content(folder) or folder  # killed between making the folder and the file
                if _moment(file.stat().st_mtime) + timedelta(seconds=self.expiry) <= now:
                    shutil.rmtree(folder)
                    gone.append(folder.name)
        return gone

    def findings(self, now: datetime) -> Iterator[str]:
        """Say what of everybody's uploads is not as it should be."""
        for folder in self.directory.glob("*/*"):
            names = sorted(path.name for path in folder.iterdir())
            contents = [name for name in names if name == PART or name.startswith(WHOLE)]
            if len(contents) != 1 or not set(names) <= {*contents, LENGTH}:
                yield f"Upload {folder.name} holds {', '.join(names) or 'nothing'}, not one file."
                continue
            file = folder / contents[0]
            late = timedelta(seconds=self.expiry) + LATE
            if self.expiry > 0 and _moment(file.stat().st_mtime) + late <= now:
                yield f"Upload {folder.name} should have expired."

    def _folder(self, id: str) -> Path:
        if not is_id(id):
            raise UnknownUpload(id[:80])
        return self.directory / hashlib.sha256(self.owner.encode()).hexdigest()[:32] / id

    def _check_number(self) -> None:
        owners = self.directory / hashlib.sha256(self.owner.encode()).hexdigest()[:32]
        if owners.exists() and sum(1 for _ in owners.iterdir()) >= MOST:
            raise TooManyUploads(MOST)


LATE = timedelta(minutes=10)
"""How long after its time an upload may still be there before the audit speaks of it."""


@dataclass(slots=True, kw_only=True)
class Writer:
    """An upload while it grows, behind its lock; made by `Uploads.write`."""

    id: str
    folder: Path
    length: int | None
    """Bytes of the whole upload, where they are known."""
    room: Room
    offset: int = 0
    """Bytes that it holds."""
    _began: int = 0
    _file: BinaryIO | None = None
    _digest: hashlib._Hash = field(default_factory=hashlib.sha256)

    def open(self, offset: int) -> None:
        """Begin, or go on after what is there, which is read once for its digest.

        Raises
        ------
        OSError
            ENOSPC: the disk has no room for the rest of it.
        """
        if self.length is not None:
            self._check(self.length)
            if self.length - offset > shutil.disk_usage(self.folder).free:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            fresh = self.folder / f"{LENGTH}.new"
            fresh.write_text(str(self.length))
            fresh.replace(self.folder / LENGTH)
        elif offset == 0:
            (self.folder / LENGTH).unlink(missing_ok=True)
        part = self.folder / PART
        if offset > 0:
            with part.open("rb") as before:
                self._digest = hashlib.file_digest(before, "sha256")
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
            raise _inconsistent(f"{self.length} bytes in all", "more")
        self._check(self.offset + len(piece))
        rest = memoryview(piece)
        try:
            while rest:
                count = self._file.write(rest)
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
            raise _inconsistent(f"{self.length} bytes in all", str(self.offset))
        found = self._digest.hexdigest()
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
        """Put what has arrived on the disk."""
        if self._file is not None:
            os.fsync(self._file.fileno())
            self._file.close()
            self._file = None

    def _check(self, size: int) -> None:
        room = self.room
        if size > room.max_bytes:
            self.close()
            shutil.rmtree(self.folder)
            raise UploadTooLarge(room.max_bytes, size)
        if room.quota > 0 and room.used + size > room.quota:
            raise QuotaExceeded(used=room.used + self.offset, quota=room.quota)


@contextmanager
def _locked(folder: Path, *, make: bool, id: str) -> Iterator[None]:
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


def _content(folder: Path) -> Path | None:
    """Return the file that holds an upload's bytes, None if there is none."""
    for _ in range(2):  # between the two looks it may have become whole
        for path in folder.glob(f"{WHOLE}*"):
            return path
        if (folder / PART).exists():
            return folder / PART
    return None


def _length(folder: Path) -> int | None:
    file = folder / LENGTH
    return int(file.read_text()) if file.exists() else None


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _inconsistent(expected: str, got: str) -> InvalidRequest:
    return InvalidRequest(
        "inconsistent_upload_length", field="Upload-Length", expected=expected, got=got,
        hint="Send what is missing, or begin anew at Upload-Offset: 0.",
    )  # fmt: skip

"""Large inputs before there is a job: files that arrive over several requests, kept on the data volume until they expire.

An upload is a folder (`uploads.folder`) that grows (`uploads.writer`); a job can take its input only from a complete one.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pliant.schemas.job import Upload
from pliant.worker.errors import Conflict, OffsetMismatch, TooManyUploads, UnknownUpload
from pliant.worker.ids import check_id, is_id
from pliant.worker.settings import Settings
from pliant.worker.uploads.folder import LENGTH, PART, RESERVED, WHOLE, content, declared_length, locked, taken
from pliant.worker.uploads.writer import Capacity as Capacity
from pliant.worker.uploads.writer import Writer as Writer
from pliant.worker.uploads.writer import inconsistent

MOST = 100
"""Uploads that one owner may have at a time."""

LATE = timedelta(minutes=10)
"""How long after its time an upload may still be there before fsck reports it."""


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
        file = content(folder)
        try:
            if file is None:
                raise UnknownUpload(id)
            held, length = file.stat(), declared_length(folder)
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
    def write(self, id: str, *, offset: int, length: int | None, capacity: Capacity) -> Iterator[Writer]:
        """Go on with an upload, or begin it at 0: what an unfinished one of that id held is thrown away then.

        Parameters
        ----------
        offset : int
            Where the bytes that follow belong; must be what the upload holds.
        length : int, optional
            Bytes of the whole upload, where they are known.
        capacity : Capacity
            How much it may take.

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
        with locked(folder, make=offset == 0, id=id):
            file = content(folder)
            if file is not None and file.name.startswith(WHOLE):
                raise Conflict(
                    "upload_complete", id=id, sentence=f"Upload {id!r} is whole. Use it, or delete it first."
                )
            if offset > 0 and file is None:
                raise UnknownUpload(id)
            held = file.stat().st_size if file is not None and offset > 0 else 0
            if offset != held:
                raise OffsetMismatch(id, expected=held, got=offset)
            known = declared_length(folder) if offset > 0 else None
            if length is not None and known not in (None, length):
                raise inconsistent(f"{known} bytes, as declared at first", str(length))
            writer = Writer(id=id, folder=folder, length=length if length is not None else known, capacity=capacity)
            try:
                writer.open(offset)
                yield writer
            finally:
                writer.close()
                if folder.exists() and content(folder) is None:  # refused before its first byte
                    shutil.rmtree(folder)

    def take(self, id: str, to: Path) -> str:
        """Give a whole upload a second name, where neither deletion nor expiry reaches it, and return its SHA-256.

        Raises
        ------
        UnknownUpload
            There is none of that id.
        Conflict
            It is not whole yet.
        """
        file = content(self._folder(id))
        if file is None:
            raise UnknownUpload(id)
        if not file.name.startswith(WHOLE):
            sentence = f"Upload {id!r} is not whole yet: send the rest of it, from the offset that HEAD reports."
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
        with locked(folder, make=False, id=id):
            shutil.rmtree(folder)

    def used(self) -> int:
        """Return the bytes that everybody's uploads hold, or have reserved while they are written to."""
        return sum(taken(folder) for folder in self.directory.glob("*/*"))

    def expire(self, now: datetime) -> list[str]:
        """Remove everybody's uploads whose time is over and which nobody writes to; return their ids."""
        gone = []
        for folder in self.directory.glob("*/*") if self.expiry > 0 else ():
            with suppress(Conflict, UnknownUpload, FileNotFoundError), locked(folder, make=False, id=folder.name):
                file = content(folder) or folder  # killed between making the folder and the file
                if _moment(file.stat().st_mtime) + timedelta(seconds=self.expiry) <= now:
                    shutil.rmtree(folder)
                    gone.append(folder.name)
        return gone

    def findings(self, now: datetime) -> Iterator[str]:
        """Yield a sentence for each upload that is inconsistent or should have expired."""
        for folder in self.directory.glob("*/*"):
            names = sorted(path.name for path in folder.iterdir())
            contents = [name for name in names if name == PART or name.startswith(WHOLE)]
            if len(contents) != 1 or not set(names) <= {*contents, LENGTH, RESERVED}:
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


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)

"""Uploads: large input files sent in several requests before a job, kept on the data volume until they expire.

An upload is a folder (`uploads.folder`), extended by `uploads.writer`. Only complete uploads can be the input of a job.
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
from pliant.worker.errors import Conflict, TooManyUploads, UnknownUpload
from pliant.worker.ids import check_id, is_id
from pliant.worker.settings import Settings
from pliant.worker.uploads.folder import LENGTH, PART, RESERVED, WHOLE, content, declared_length, locked, taken
from pliant.worker.uploads.writer import Capacity, Held, Writer, continued, incomplete

MAX_UPLOADS = 100
"""Maximum number of uploads per owner."""

LATE = timedelta(minutes=10)
"""Time after its expiry at which fsck reports an upload that still exists."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Uploads:
    """The uploads of one owner, or of a service without authentication."""

    directory: Path
    expiry: float
    """Seconds after its last byte or last use at which an upload is removed; 0: never."""
    owner: str = ""

    @classmethod
    def open(cls, settings: Settings) -> Uploads:
        """Return the uploads of an installation; folders are created on first use."""
        return cls(directory=settings.uploads, expiry=settings.upload_expiry)

    def of(self, owner: str) -> Uploads:
        """Return the uploads of this owner."""
        return replace(self, owner=owner)

    def get(self, id: str) -> Upload:
        """Return the state of an upload.

        Raises
        ------
        UnknownUpload
            No upload has this id.
        """
        folder = self._folder(id)
        while (file := content(folder)) is not None:
            with suppress(FileNotFoundError):  # it was completed, i.e. renamed, or removed meanwhile
                held, length = file.stat(), declared_length(folder)
                break
        else:
            raise UnknownUpload(id)
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
        """Return the state of an upload, None if no upload has this id."""
        with suppress(UnknownUpload):
            return self.get(id)
        return None

    @contextmanager
    def write(self, id: str, *, offset: int, length: int | None, capacity: Capacity) -> Iterator[Writer]:
        """Resume an upload, or start it at offset 0, which discards an incomplete one of the same id.

        `offset` must equal the current size of the upload in bytes; `length` is the size of the complete upload in bytes, if known.

        Raises
        ------
        Conflict
            The upload is complete or being written; `OffsetMismatch` if its size differs from `offset`.
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
            held = (
                None
                if file is None
                else Held(
                    offset=file.stat().st_size, length=declared_length(folder), complete=file.name.startswith(WHOLE)
                )
            )
            agreed = continued(id, held, offset=offset, length=length)
            writer = Writer(id=id, folder=folder, length=agreed, capacity=capacity)
            try:
                writer.open(offset)
                yield writer
            finally:
                writer.close()
                if folder.exists() and content(folder) is None:  # rejected before its first byte
                    shutil.rmtree(folder)

    def take(self, id: str, to: Path) -> str:
        """Link a complete upload to another name, so that deletion and expiry do not affect it; return its SHA-256.

        Raises
        ------
        UnknownUpload
            No upload has this id.
        Conflict
            The upload is not complete yet.
        """
        file = content(self._folder(id))
        if file is None:
            raise UnknownUpload(id)
        if not file.name.startswith(WHOLE):
            raise incomplete(id)
        try:
            os.utime(file)  # use restarts the retention period
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
        """Remove an upload, complete or not.

        Raises
        ------
        UnknownUpload
            No upload has this id.
        Conflict
            The upload is being written.
        """
        folder = self._folder(id)
        with locked(folder, make=False, id=id):
            shutil.rmtree(folder)

    def used(self) -> int:
        """Return the total bytes of all uploads, including reservations."""
        return sum(taken(folder) for folder in self.directory.glob("*/*"))

    def expire(self, now: datetime) -> list[str]:
        """Remove all expired uploads that are not being written; return their ids."""
        gone = []
        for folder in self.directory.glob("*/*") if self.expiry > 0 else ():
            with suppress(Conflict, UnknownUpload, FileNotFoundError), locked(folder, make=False, id=folder.name):
                file = content(folder) or folder  # the process was killed between creating the folder and the file
                if _moment(file.stat().st_mtime) + timedelta(seconds=self.expiry) <= now:
                    shutil.rmtree(folder)
                    gone.append(folder.name)
        return gone

    def findings(self, now: datetime) -> Iterator[str]:
        """Yield a sentence for each upload that is inconsistent or should have expired."""
        late = timedelta(seconds=self.expiry) + LATE
        for folder in self.directory.glob("*/*"):
            with suppress(FileNotFoundError):  # it was completed or removed meanwhile
                names = sorted(path.name for path in folder.iterdir())
                contents = [name for name in names if name == PART or name.startswith(WHOLE)]
                if len(contents) != 1 or not set(names) <= {*contents, LENGTH, RESERVED}:
                    yield f"Upload {folder.name} holds {', '.join(names) or 'nothing'}; expected exactly one file."
                elif self.expiry > 0 and _moment((folder / contents[0]).stat().st_mtime) + late <= now:
                    yield f"Upload {folder.name} should have expired."

    def _folder(self, id: str) -> Path:
        if not is_id(id):
            raise UnknownUpload(id[:80])
        return self.directory / self._owner / id

    @property
    def _owner(self) -> str:
        """Name of the owner in paths and keys."""
        return hashlib.sha256(self.owner.encode()).hexdigest()[:32]

    def _check_number(self) -> None:
        owners = self.directory / self._owner
        if owners.exists() and sum(1 for _ in owners.iterdir()) >= MAX_UPLOADS:
            raise TooManyUploads(MAX_UPLOADS)


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)

"""Uploads of installations that store files in S3: any API process can continue an upload that another one began.

The bytes are stored as pieces in the blob store under `uploads/`, the state in Redis (`uploads.states`). A piece counts once the state
names it, and only the newest request may add one, so neither locks nor repairs are needed.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pliant.schemas.job import Upload
from pliant.worker.errors import Conflict, QuotaExceeded, TooManyUploads, UnknownUpload
from pliant.worker.ids import check_id, is_id
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.uploads.service import LATE, MAX_UPLOADS, Uploads
from pliant.worker.uploads.states import RESERVED_FOR, State, UploadStates, open_states
from pliant.worker.uploads.writer import Capacity, Held, Writer, continued, incomplete

FOLDER = "uploads/"
"""Prefix of the blob keys."""

PIECE = 4 << 20
"""Bytes of a piece, and of memory per upload. If a process is killed, its clients resend the bytes that are not stored yet."""

STRAY = timedelta(hours=1)
"""Age above which a piece that no state names is removed; a younger one may not be named yet."""


def open_uploads(settings: Settings, blobs: Blobs) -> Uploads:
    """Return the uploads of an installation: shared if its files are in an object store, else in the data directory."""
    if not blobs.remote:
        return Uploads.open(settings)
    states = open_states(settings.redis, settings.queue)
    return SharedUploads(directory=settings.uploads, expiry=settings.upload_expiry, blobs=blobs, states=states)


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedUploads(Uploads):
    """The uploads of one owner in the stores that all API processes share. Every method may raise `StoreUnavailable`."""

    blobs: Blobs
    states: UploadStates

    def get(self, id: str) -> Upload:
        state = self._state(id)
        if state is None:
            raise UnknownUpload(id)
        expires = None if self.expiry == 0 else datetime.fromtimestamp(state.touched + self.expiry, UTC)
        return Upload(
            id=id, offset=state.offset, length=state.length, complete=state.sha256 is not None, sha256=state.sha256,
            expires_at=expires,
        )  # fmt: skip

    @contextmanager
    def write(self, id: str, *, offset: int, length: int | None, capacity: Capacity) -> Iterator[Writer]:
        """See `Uploads.write`. A newer request takes over from an older one, which fails at its next piece."""
        if offset == 0:
            check_id(id)
        before = self._state(id)
        held = (
            None
            if before is None
            else Held(offset=before.offset, length=before.length, complete=before.sha256 is not None)
        )
        agreed = continued(id, held, offset=offset, length=length)
        if before is None and sum(name.startswith(f"{self._owner}/") for name in self.states.names()) >= MAX_UPLOADS:
            raise TooManyUploads(MAX_UPLOADS)
        writer = SharedWriter(
            id=id, folder=self.directory, length=agreed, capacity=capacity, uploads=self, before=before
        )
        try:
            writer.open(offset)
            yield writer
        finally:
            writer.close()

    def take(self, id: str, to: Path) -> str:
        """See `Uploads.take`. The pieces are copied into one file."""
        state = self._state(id)
        if state is None:
            raise UnknownUpload(id)
        if state.sha256 is None:
            raise incomplete(id)
        try:
            with to.open("wb") as out:
                for chunk in self.read(id, state):
                    out.write(chunk)
        except FileNotFoundError:  # the upload was deleted meanwhile
            raise UnknownUpload(id) from None
        self.states.swap(self.name(id), state, state.model_copy(update={"touched": time.time()}))
        return state.sha256

    def delete(self, id: str) -> None:
        """See `Uploads.delete`. A request that writes to it fails at its next piece."""
        while (state := self._state(id)) is not None:
            if self.discard(self.name(id), state):
                return
        raise UnknownUpload(id)

    def used(self) -> int:
        now = time.time()
        return sum(state.taken(now) for state in self.states.all().values())

    def expire(self, now: datetime) -> list[str]:
        """See `Uploads.expire`. Pieces that belong to no upload are removed, too."""
        held, gone = self.states.all(), []
        for name, state in held.items():
            late = self.expiry > 0 and state.touched + self.expiry <= now.timestamp()
            if late and self.discard(name, state):
                gone.append(name.rpartition("/")[2])
        named = _keys(held)
        for key, written in self.blobs.list(FOLDER):
            if written < now - STRAY and key not in named:
                self.blobs.delete(key)
        return gone

    def findings(self, now: datetime) -> Iterator[str]:
        sizes, held = self.blobs.sizes(FOLDER), self.states.all()
        for name, state in held.items():
            lost = [key for key, size in state.pieces if sizes.get(f"{FOLDER}{name}/{state.generation}/{key}") != size]
            if lost:
                yield f"Upload {name.rpartition('/')[2]} has lost {len(lost)} of its {len(state.pieces)} pieces."
            if self.expiry > 0 and state.touched + self.expiry + LATE.total_seconds() <= now.timestamp():
                yield f"Upload {name.rpartition('/')[2]} should have expired."
        named = _keys(held)
        for key, written in self.blobs.list(FOLDER):
            if written < now - STRAY - LATE and key not in named:
                yield f"File {key} belongs to no upload."

    def name(self, id: str) -> str:
        """Return the name of an upload, which is unique across owners.

        Raises
        ------
        UnknownUpload
            The id is malformed.
        """
        if not is_id(id):
            raise UnknownUpload(id[:80])
        return f"{self._owner}/{id}"

    def read(self, id: str, state: State) -> Iterator[bytes]:
        """Yield the stored bytes.

        Raises
        ------
        FileNotFoundError
            The upload was deleted meanwhile.
        """
        for key, size in state.pieces:
            yield self.blobs.read_range(f"{FOLDER}{self.name(id)}/{state.generation}/{key}", 0, size)

    def discard(self, name: str, state: State) -> bool:
        """Remove an upload with its bytes if its state is unchanged; return whether it was removed."""
        if not self.states.swap(name, state, None):
            return False
        self.blobs.delete(f"{FOLDER}{name}/{state.generation}/")
        return True

    def _state(self, id: str) -> State | None:
        return self.states.get(self.name(id))


def _keys(held: dict[str, State]) -> set[str]:
    """Return the blob keys of all pieces that the states name."""
    return {f"{FOLDER}{name}/{state.generation}/{piece}" for name, state in held.items() for piece, _ in state.pieces}


@dataclass(slots=True, kw_only=True)
class SharedWriter(Writer):
    """An upload open for writing; created by `SharedUploads.write`."""

    uploads: SharedUploads
    before: State | None
    """The state that the request found."""
    _state: State | None = None
    """The state that this request wrote last; None before `open` and after the writer has ended."""
    _unsent: bytearray = field(default_factory=bytearray)

    def open(self, offset: int) -> None:
        """Start or resume after the existing bytes, and take over from an older request."""
        fresh = State(generation=secrets.token_hex(6), writer="", touched=0)
        kept = fresh if offset == 0 or self.before is None else self.before
        state = kept.model_copy(
            update={"writer": secrets.token_hex(6), "length": self.length, "touched": time.time(), "reserved": 0}
        )
        if not self.uploads.states.swap(self._name, self.before, state):
            raise self._taken_over()
        self._state, self.offset, self._began = state, offset, offset
        if self.before is not None and self.before.generation != state.generation:
            self.uploads.blobs.delete(f"{FOLDER}{self._name}/{self.before.generation}/")
        try:
            self._check(self.length or 0)
        except QuotaExceeded:
            if offset == 0:
                self._discard()
            raise

    def _append(self, piece: bytes) -> None:
        """Buffer bytes until they fill a piece. Raises Conflict if a newer request writes to this upload, or it was deleted."""
        self._unsent += piece
        self.offset += len(piece)
        if self._began == 0:
            self._digest.update(piece)
        if len(self._unsent) >= PIECE:
            self._store()
        elif self._state is not None and time.time() > self._state.touched + RESERVED_FOR / 2:
            self._swap()  # a slow connection takes minutes for a piece, and its reservation must not lapse meanwhile

    def _sha256(self) -> str:
        """Store the buffered bytes; return the digest of the complete upload."""
        self._store()
        assert self._state is not None
        if self._began > 0:
            for chunk in self.uploads.read(self.id, self._state):
                self._digest.update(chunk)
        return self._digest.hexdigest()

    def _complete(self, found: str) -> None:
        self._swap(sha256=found, length=self.offset, reserved=0)
        self._state = None

    def close(self) -> None:
        """Store the received bytes, and release the unused reservation. Nothing happens after `finish` or a failure."""
        if self._state is not None:
            self._store()
            if self._state.reserved > 0:
                self._swap(reserved=0)
            self._state = None

    @property
    def _name(self) -> str:
        return self.uploads.name(self.id)

    def _store(self) -> None:
        """Store the buffered bytes as one piece."""
        if not self._unsent or self._state is None:
            return
        key, data = f"{len(self._state.pieces):05d}-{secrets.token_hex(4)}", bytes(self._unsent)
        whole = f"{FOLDER}{self._name}/{self._state.generation}/{key}"
        self.uploads.blobs.write(whole, data)
        try:
            self._swap(pieces=(*self._state.pieces, (key, len(data))))
        except Conflict:
            self.uploads.blobs.delete(whole)
            raise
        self._unsent.clear()

    def _swap(self, **update: object) -> None:
        assert self._state is not None
        after = self._state.model_copy(update={"touched": time.time(), **update})
        if not self.uploads.states.swap(self._name, self._state, after):
            self._state = None
            raise self._taken_over()
        self._state = after

    def _taken_over(self) -> Conflict:
        sentence = (
            f"A newer request writes to upload {self.id!r}, or it was deleted. Query its offset before you continue."
        )
        return Conflict("upload_taken_over", id=self.id, sentence=sentence)

    def _discard(self) -> None:
        if self._state is not None:
            self.uploads.discard(self._name, self._state)
            self._state = None

    def _reserve(self, size: int) -> None:
        if self._state is None or self.capacity.quota == 0 or size <= self._state.reserved:
            return
        with self.uploads.states.counting():
            others = self.uploads.used() - self._state.taken(time.time())
            self._swap(reserved=self._share(size, others))

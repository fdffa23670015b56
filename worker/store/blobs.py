"""Blobs: inputs and artifacts as files under keys, in a directory or in an object store, by URL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import obstore
from obstore.exceptions import BaseError
from obstore.store import MemoryStore, ObjectStore, from_url
from pliant.worker.errors import StoreUnavailable

CHUNK = 1 << 20
"""Bytes handed out at a time."""


@dataclass(frozen=True, slots=True)
class Blob:
    """One stored file, readable in ranges."""

    _store: ObjectStore
    key: str
    size: int
    """Bytes."""

    def read(self, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        """Yield the bytes from `start` up to, not including, `end` (None: to the end), a chunk at a time.

        Raises
        ------
        ValueError
            The range is not within the file.
        StoreUnavailable
            The store does not answer.
        """
        stop = self.size if end is None else end
        if not 0 <= start <= stop <= self.size:
            raise ValueError(f"range {start}–{stop} of a file of {self.size} bytes")
        if start == stop:
            return
        with answering():
            got = obstore.get(self._store, self.key, options={"range": (start, stop)})
            for batch in got.stream(min_chunk_size=CHUNK):
                whole = memoryview(batch)
                for offset in range(0, len(whole), CHUNK):
                    yield bytes(whole[offset : offset + CHUNK])


class Blobs:
    """A store of files under slash-separated keys."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store

    @classmethod
    def open(cls, url: str) -> Blobs:
        """Open `file:///directory` (made if need be), `s3://bucket/prefix` or `memory:///`.

        An object store's credentials and endpoint are read from its usual environment variables (`AWS_…`).
        """
        if url.startswith("memory:"):
            return cls(MemoryStore())
        with answering():
            if url.startswith("file:"):
                return cls(from_url(url, mkdir=True, automatic_cleanup=True))
            return cls(from_url(url))

    def put(self, key: str, file: Path) -> int:
        """Store a file whole or not at all; return its size in bytes."""
        with answering():
            obstore.put(self._store, key, file)
        return file.stat().st_size

    def get(self, key: str) -> Blob:
        """Return a stored file.

        Raises
        ------
        FileNotFoundError
            There is none under this key.
        StoreUnavailable
            The store does not answer.
        """
        with answering():
            return Blob(self._store, key, int(obstore.head(self._store, key)["size"]))

    def fetch(self, key: str, file: Path) -> None:
        """Copy a stored file to a local one."""
        with file.open("wb") as out:
            for chunk in self.get(key).read():
                out.write(chunk)

    def copy(self, key: str, to: str) -> None:
        """Copy within the store."""
        with answering():
            obstore.copy(self._store, key, to)

    def delete(self, prefix: str) -> None:
        """Remove everything under a prefix that ends with a slash, or one file; nothing happens if there is nothing."""
        keys = [key for key, _ in self.list(prefix)] if prefix.endswith("/") else [prefix]
        with answering():
            for key in keys:
                try:
                    obstore.delete(self._store, key)
                except FileNotFoundError:
                    continue

    def list(self, prefix: str = "") -> list[tuple[str, datetime]]:
        """Return key and time of writing of everything under a prefix."""
        with answering():
            return [
                (str(each["path"]), each["last_modified"])
                for batch in obstore.list(self._store, prefix.rstrip("/") or None)
                for each in batch
            ]

    def sizes(self, prefix: str = "") -> dict[str, int]:
        """Return the size in bytes of everything under a prefix, by key."""
        with answering():
            batches = obstore.list(self._store, prefix.rstrip("/") or None)
            return {str(each["path"]): int(each["size"]) for batch in batches for each in batch}

    def check(self) -> None:
        """Return if the store answers."""
        with answering():
            obstore.list_with_delimiter(self._store, "jobs-that-never-are")


@contextmanager
def answering() -> Iterator[None]:
    """Turn the store's failures into `StoreUnavailable`; a missing file stays `FileNotFoundError`."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (BaseError, OSError) as error:
        raise StoreUnavailable("The blob store", reason=str(error).splitlines()[0][:200]) from error

"""The blob store: inputs and artifacts as files under keys, in a directory or an object store, selected by URL."""

from __future__ import annotations

import errno
import logging
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import BaseError
from obstore.store import MemoryStore, ObjectStore, S3Store, from_url
from pliant.worker.errors import InvalidSetting, StoreUnavailable
from pliant.worker.store.calls import RemoteCalls

logger = logging.getLogger(__name__)

CHUNK = 1 << 20
"""Bytes per chunk of a download."""

BLOCK = 4 << 20
"""Bytes per request to a remote store, so that each request can have a time limit."""

ANSWER_WITHIN = 8.0
"""Time limit of one call to a remote store, seconds."""

SLOWEST = 1 << 20
"""Bytes per second below which a transfer to a remote store counts as stalled."""

CLIENT: Any = {"connect_timeout": "3s", "timeout": "15s"}
RETRIES: Any = {
    "max_retries": 2,
    "retry_timeout": timedelta(seconds=5),
    "backoff": {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=1), "base": 2},
}
"""Time limits and retries of one HTTP request to a remote store; together they stay below `ANSWER_WITHIN` if packets are dropped."""

SWITCHES = ("allow_http", "allow_invalid_certificates", "http1_only", "http2_only")
TEXTS = ("proxy_url", "proxy_ca_certificate", "proxy_excludes", "user_agent")
"""Connection options for S3, set by the `AWS_…` variables of the same names."""

LONGEST_MESSAGE = 2000
"""Characters of a store's message that are logged: it may contain a proxy's page."""

FAULTS_OF_DISKS = tuple(os.strerror(number) for number in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES))
"""The system's sentences for a directory that takes no files; they name no path."""

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Blob:
    """One stored file, readable in ranges."""

    _blobs: Blobs
    key: str
    size: int
    """Bytes."""

    def link(self, *, seconds: float) -> str | None:
        """Return a URL from which anyone can read the file for `seconds`, None if the store has no such URLs.

        Raises
        ------
        StoreUnavailable
            The credentials for signing cannot be read.
        """
        return self._blobs.link(self.key, seconds=seconds)

    def read(self, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        """Yield the bytes from `start` up to, not including, `end` (None: to the end), in chunks.

        Raises
        ------
        ValueError
            The range is not within the file.
        FileNotFoundError
            The file was removed in the meantime.
        StoreUnavailable
            The store does not answer.
        """
        stop = self.size if end is None else end
        if not 0 <= start <= stop <= self.size:
            raise ValueError(f"range {start}–{stop} of a file of {self.size} bytes")
        for block in range(start, stop, BLOCK):
            whole = memoryview(self._blobs.read_range(self.key, block, min(block + BLOCK, stop)))
            for offset in range(0, len(whole), CHUNK):
                yield bytes(whole[offset : offset + CHUNK])


Entries = list[Any]


class Blobs:
    """A store of files under slash-separated keys. Every method may raise `StoreUnavailable`.

    Calls to a remote store have a time limit and run in a small thread pool, so that a store that hangs delays nothing else.

    Attributes
    ----------
    directory : Path or None
        Directory of the files; None for a remote store.
    """

    def __init__(self, store: ObjectStore, *, directory: Path | None = None, remote: bool = False) -> None:
        self._store = store
        self.directory = directory
        self._calls = RemoteCalls() if remote else None

    @classmethod
    def open(cls, url: str) -> Blobs:
        """Open `file:///directory` (created if missing), `s3://bucket/prefix` or `memory:///`.

        An object store's credentials and endpoint are read from its usual environment variables (`AWS_…`).

        Raises
        ------
        InvalidSetting
            The text is not a URL, or one of another kind of store; or an `AWS_…` variable is invalid.
        """
        if url.startswith("memory:"):
            return cls(MemoryStore())
        expected = "file:///FOLDER or s3://BUCKET/PREFIX"
        with answering():
            if url.startswith("file:"):
                if not url.startswith(("file:///", "file://localhost/")):
                    raise InvalidSetting("PLIANT_BLOB_URL", expected=expected, got=repr(url))
                store = from_url(url, mkdir=True, automatic_cleanup=True)
                return cls(store, directory=Path(unquote(urlsplit(url).path)))
            try:
                scheme, bucket, *_ = urlsplit(url)
                if scheme != "s3" or not bucket:
                    raise ValueError(url)
            except ValueError:
                raise InvalidSetting("PLIANT_BLOB_URL", expected=expected, got=repr(url)) from None
            options: Any = {**CLIENT, **client_options(os.environ)}
            try:
                return cls(from_url(url, client_options=options, retry_config=RETRIES), remote=True)
            except (ValueError, BaseError) as fault:
                raise InvalidSetting(
                    "AWS_… variables",
                    expected=f"values with which {url} can be opened",
                    got=f"the error {str(fault).splitlines()[0]!r}",
                    hint="docs/how-to/s3.md lists the variables.",
                ) from None

    def put(self, key: str, file: Path, *, media_type: str = "application/octet-stream") -> int:
        """Store a file atomically and durably; return its size in bytes.

        A local store links the file if possible instead of copying it: do not write to it afterwards. A remote store also keeps
        the media type, and the last part of the key as the file name, for downloads through `Blob.link`.
        """
        size = file.stat().st_size
        local = self._local(key)
        if local is None or not _linked(file, local):
            named = f'attachment; filename="{key.rpartition("/")[2]}"'
            shown: Any = {"Content-Type": media_type, "Content-Disposition": named} if self._calls is not None else None
            self._call(
                lambda: obstore.put(self._store, key, file, attributes=shown), seconds=ANSWER_WITHIN + size / SLOWEST
            )
        self._write_to_disk(local)
        return size

    def write(self, key: str, data: bytes) -> None:
        """Store bytes atomically and durably."""
        self._call(lambda: obstore.put(self._store, key, data), seconds=ANSWER_WITHIN + len(data) / SLOWEST)
        self._write_to_disk(self._local(key))

    @property
    def remote(self) -> bool:
        """Whether this is an object store, which other hosts can reach, too."""
        return self._calls is not None

    def link(self, key: str, *, seconds: float) -> str | None:
        """Return a URL from which anyone can read a file for `seconds`, None if the store is not S3; see `Blob.link`."""
        store = self._store
        if not isinstance(store, S3Store):
            return None
        return self._call(lambda: obstore.sign(store, "GET", key, timedelta(seconds=seconds)))

    def get(self, key: str) -> Blob:
        """Return a stored file.

        Raises
        ------
        FileNotFoundError
            There is no file under this key.
        """
        return Blob(self, key, int(self._call(lambda: obstore.head(self._store, key))["size"]))

    def read_range(self, key: str, start: int, end: int) -> bytes:
        """Return the bytes of a stored file from `start` up to, not including, `end`.

        Raises
        ------
        FileNotFoundError
            There is no file under this key.
        """
        return self._call(lambda: bytes(obstore.get_range(self._store, key, start=start, end=end)))

    def fetch(self, key: str, file: Path) -> None:
        """Copy a stored file to a local path, or link it if the store is local. Do not write to it."""
        local = self._local(key)
        if local is not None and _linked(local, file):
            return
        with file.open("wb") as out:
            for chunk in self.get(key).read():
                out.write(chunk)

    def copy(self, key: str, to: str) -> None:
        """Copy within the store, durably.

        Raises
        ------
        FileNotFoundError
            There is no file under this key.
        """
        self._call(lambda: obstore.copy(self._store, key, to))
        self._write_to_disk(self._local(to))

    def delete(self, prefix: str) -> None:
        """Remove one file, or all files under a prefix that ends with a slash; missing ones are ignored."""
        keys = [key for key, _ in self.list(prefix)] if prefix.endswith("/") else [prefix]
        for key in keys:
            with suppress(FileNotFoundError):
                self._call(lambda key=key: obstore.delete(self._store, key))  # type: ignore[misc]

    def clear_unfinished(self, *, before: datetime) -> None:
        """Remove the temporary files that killed processes last wrote before a time. A directory keeps them, and lists none."""
        for path in self.directory.rglob("*#*") if self.directory is not None else ():
            with suppress(FileNotFoundError):
                if path.stat().st_mtime < before.timestamp():
                    path.unlink()

    def list(self, prefix: str = "") -> list[tuple[str, datetime]]:
        """Return key and modification time of all files under a prefix."""
        return [(str(each["path"]), each["last_modified"]) for each in self._entries(prefix)]

    def sizes(self, prefix: str = "") -> dict[str, int]:
        """Return the size in bytes of all files under a prefix, by key."""
        return {str(each["path"]): int(each["size"]) for each in self._entries(prefix)}

    def check(self) -> None:
        """Return normally if the store answers and, if it is a directory, takes files."""
        if self.directory is None:
            self._call(lambda: obstore.list_with_delimiter(self._store, "jobs-that-never-are"))
            return
        with answering():
            self.directory.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.directory) as probe:
                probe.write(bytes(os.statvfs(self.directory).f_bsize))

    def _write_to_disk(self, file: Path | None) -> None:
        """Write a local file and the directories that lead to it to the disk, so that a power failure cannot lose or empty it."""
        if file is None:
            return
        with answering():
            for path in (file, *(each for each in file.parents if each.is_relative_to(self.directory or file))):
                descriptor = os.open(path, os.O_RDONLY)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)

    def _local(self, key: str) -> Path | None:
        """Return the path of a key; None if the store is remote or the key is invalid."""
        plain = all(part not in ("", ".", "..") for part in key.split("/"))
        return self.directory / key if self.directory is not None and plain else None

    def _entries(self, prefix: str) -> Entries:
        batches = iter(obstore.list(self._store, prefix.rstrip("/") or None))
        found: Entries = []
        while batch := self._call(lambda: next(batches, None)):
            found += batch
        return found

    def _call(self, call: Callable[[], Answer], *, seconds: float = ANSWER_WITHIN) -> Answer:
        def answered() -> Answer:
            with answering():
                return call()

        return answered() if self._calls is None else self._calls.run(answered, seconds=seconds)


def client_options(environment: Mapping[str, str]) -> dict[str, object]:
    """Return the connection options set by `AWS_…` variables, which obstore ignores if it is given other options.

    obstore itself reads those for credentials, region and endpoint. `AWS_TIMEOUT` and `AWS_CONNECT_TIMEOUT` have no effect, because
    the time limits here depend on each other.

    Raises
    ------
    InvalidSetting
        The file of `AWS_CA_BUNDLE` cannot be read.
    """
    given: dict[str, object] = {}
    for name in SWITCHES:
        text = environment.get(f"AWS_{name.upper()}", "").strip().lower()
        if text:
            given[name] = text in ("1", "t", "true", "yes", "on")
    for name in TEXTS:
        if text := environment.get(f"AWS_{name.upper()}", "").strip():
            given[name] = text
    certificates = environment.get("AWS_CA_BUNDLE", "").strip()
    if certificates:
        try:
            given["root_certificate"] = Path(certificates).read_text()
        except (OSError, ValueError) as fault:
            raise InvalidSetting(
                "AWS_CA_BUNDLE", expected="a PEM file that this user can read", got=str(fault)
            ) from None
    return given


def _linked(source: Path, target: Path) -> bool:
    """Hard-link a file; return False if it must be copied (another file system, or one without links)."""
    fresh = target.with_name(f"{target.name}#{secrets.randbits(63)}")  # the store does not list such names
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        os.link(source, fresh)
        fresh.replace(target)
    except OSError:  # or the source is missing, which the store reports
        return False
    with suppress(FileNotFoundError):  # `replace` does nothing if both names are the same file
        fresh.unlink()
    return True


@contextmanager
def answering() -> Iterator[None]:
    """Translate failures of the store to `StoreUnavailable`; a missing file stays `FileNotFoundError`.

    The store's message is only logged, since it contains endpoint, bucket and key. It has several lines: an S3 server's reason is in the
    second, the reason for which a connection failed in the last.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except (BaseError, OSError) as error:
        logger.warning("blob store: %s", " ".join(str(error).split())[:LONGEST_MESSAGE])
        reason = next((fault for fault in FAULTS_OF_DISKS if fault in str(error)), type(error).__name__)
        raise StoreUnavailable("The blob store", reason=reason) from error

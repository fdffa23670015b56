"""Fetching a file: streamed, resumed where it broke off, and checked."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import httpx
from pliant.client.errors import CorruptDownload
from pliant.client.flow import Call, Do, Flow, Head, Pull
from pliant.client.multipart import OnBytes
from pliant.client.retry import Attempts
from pliant.client.transport import opened, pause_or_raise
from pliant.schemas.job import Artifact


def download(
    attempts: Attempts, path: str, artifact: Artifact, folder: Path, *, on_download: OnBytes | None
) -> Flow[Path]:
    """Fetch an artifact into a folder, under its own name.

    The bytes go to a file beside it whose name holds the SHA-256; it is renamed when whole and right, so that a file under
    the artifact's name is never half a file. A part left by an earlier, interrupted call is continued.

    Raises
    ------
    CorruptDownload
        The bytes were wrong twice.
    """
    folder.mkdir(parents=True, exist_ok=True)
    whole = folder / Path(artifact.name).name
    if (
        whole.is_file()
        and whole.stat().st_size == artifact.bytes
        and (yield Do(lambda: sha256(whole))) == artifact.sha256
    ):
        return whole
    part = folder / f".{whole.name}.{artifact.sha256[:16]}.part"
    for _ in range(2):
        if not part.is_file() or part.stat().st_size < artifact.bytes or artifact.bytes == 0:
            yield from _fill(attempts, path, artifact, part, on_download)
        if (yield Do(lambda: sha256(part))) == artifact.sha256:
            part.replace(whole)
            return whole
        part.unlink()
    raise CorruptDownload(
        f"{artifact.name} does not have the SHA-256 {artifact.sha256} that its job names, although it was fetched twice. "
        "Something between here and the service changes the bytes; try another way to it."
    )


def _fill(attempts: Attempts, path: str, artifact: Artifact, part: Path, on_download: OnBytes | None) -> Flow[None]:
    """Append to the part until it has all its bytes.

    The service's entity tag is the SHA-256, so `If-Range` holds over restarts of both sides: if the file is not the same
    any more, it comes whole.
    """
    with part.open("ab") as file:
        while True:
            headers = {"Accept-Encoding": "identity"}
            if file.tell() > 0:
                headers |= {"Range": f"bytes={file.tell()}-", "If-Range": f'"{artifact.sha256}"'}
            call = Call(method="GET", path=path, headers=headers)
            head = yield from opened(attempts, call)
            if _begins_at(head) != file.tell():
                file.seek(0)
                file.truncate()
            try:
                while (chunk := (yield Pull())) != b"":
                    attempts.remaining()
                    attempts.succeeded()
                    file.write(chunk)
                    if on_download is not None:
                        on_download(file.tell(), artifact.bytes)
            except httpx.TransportError as lost:
                yield from pause_or_raise(attempts, call, lost)
                if file.tell() >= artifact.bytes:
                    return
            else:
                return


def _begins_at(head: Head) -> int:
    """Where the bytes of an answer belong: 0 for a whole file, else as Content-Range says."""
    if head.status != 206:
        return 0
    match = re.match(r"bytes (\d+)-", head.headers.get("content-range", ""))
    return int(match.group(1)) if match is not None else -1


def sha256(path: Path) -> str:
    """Hash a file without holding it in memory."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

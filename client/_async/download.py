"""Downloading a file: streamed, resumed after interruptions, checked by SHA-256."""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path

import httpx
from pliant.client._async.transport import Exchange
from pliant.client.call import Call
from pliant.client.errors import CorruptDownload
from pliant.client.locks import lock
from pliant.client.multipart import OnBytes
from pliant.client.pauses import async_sleep, in_thread
from pliant.schemas.digests import sha256
from pliant.schemas.job import Artifact


async def download(
    exchange: Exchange, path: str, artifact: Artifact, folder: Path, *, on_download: OnBytes | None
) -> Path:
    """Download an artifact into a folder, under its own name.

    The bytes go to a partial file in the same folder, whose name contains the SHA-256. It is renamed once it is complete and
    correct, so a file with the artifact's name is always complete. A partial file of an earlier call is continued, and that of a
    call under way is waited for.

    Raises
    ------
    CorruptDownload
        The SHA-256 was wrong after two downloads.
    """
    folder.mkdir(parents=True, exist_ok=True)
    whole = folder / Path(artifact.name).name
    part = folder / f".{whole.name}.{artifact.sha256[:16]}.part"
    while not await _complete(whole, artifact):
        held = lock(part)
        if held is None:  # another call downloads this file into this folder: wait for it
            exchange.attempts.remaining()
            await async_sleep(exchange.attempts.retries.poll_interval)
            continue
        with held:
            await _fetch(exchange, path, artifact, part, on_download=on_download)
            part.replace(whole)
        break
    return whole


async def _complete(whole: Path, artifact: Artifact) -> bool:
    """Return True if the file is there and correct."""
    return (
        whole.is_file()
        and whole.stat().st_size == artifact.bytes
        and await in_thread(partial(sha256, whole)) == artifact.sha256
    )


async def _fetch(exchange: Exchange, path: str, artifact: Artifact, part: Path, *, on_download: OnBytes | None) -> None:
    """Complete the partial file; download it once more if its SHA-256 is wrong. Raises as `download`."""
    for _ in range(2):
        if part.stat().st_size < artifact.bytes or artifact.bytes == 0:
            await _fill(exchange, path, artifact, part, on_download=on_download)
        if await in_thread(partial(sha256, part)) == artifact.sha256:
            return
        os.truncate(part, 0)
    part.unlink()
    raise CorruptDownload(
        f"{artifact.name} was downloaded twice and does not have the SHA-256 {artifact.sha256} of the job's record. "
        "Something between this machine and the service changes the bytes; try another connection."
    )


async def _fill(exchange: Exchange, path: str, artifact: Artifact, part: Path, *, on_download: OnBytes | None) -> None:
    """Append to the partial file until it is complete.

    The service's entity tag is the SHA-256, so `If-Range` remains valid across restarts of client and service. A file that has
    changed is sent from the beginning.
    """
    with part.open("ab") as file:
        while True:
            headers = {"Accept-Encoding": "identity"}
            if file.tell() > 0:
                headers |= {"Range": f"bytes={file.tell()}-", "If-Range": f'"{artifact.sha256}"'}
            call = Call(method="GET", path=path, headers=headers)
            try:
                async with exchange.download(call) as response:
                    if _first_byte(response) != file.tell():
                        file.seek(0)
                        file.truncate()
                    async for chunk in response.aiter_bytes():
                        exchange.attempts.remaining()
                        exchange.attempts.succeeded()
                        file.write(chunk)
                        if on_download is not None:
                            on_download(file.tell(), artifact.bytes)
            except httpx.TransportError as lost:
                await exchange.pause_or_raise(call, lost)
                if file.tell() >= artifact.bytes:
                    return
            else:
                return


def _first_byte(response: httpx.Response) -> int:
    """Return the offset of the response's first byte in the file, or -1 if Content-Range is malformed."""
    if response.status_code != 206:
        return 0
    match = re.match(r"bytes (\d+)-", response.headers.get("content-range", ""))
    return int(match.group(1)) if match is not None else -1

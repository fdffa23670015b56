"""Uploading large files before their job: raw bytes, resumed from the last stored byte."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import httpx
from pliant.client import multipart
from pliant.client._async.transport import Exchange, parse, read, refusal
from pliant.client.call import Call
from pliant.client.errors import APIStatusError, NotFound, PliantError, TooManyRequests
from pliant.client.multipart import Form, Remainder
from pliant.client.pauses import async_sleep, in_thread
from pliant.client.retry import OUT_OF_STEP
from pliant.schemas.digests import REPR_DIGEST, repr_digest, sha256
from pliant.schemas.job import Upload


async def upload_large(exchange: Exchange, form: Form, key: str) -> Form:
    """Upload the large files of a form and return the form that refers to them.

    A form whose files are small is returned unchanged. With the same `key` and content, the bytes that an earlier run uploaded are reused.
    """
    if form.size <= multipart.RESUMABLE_BYTES:
        return form
    total, before, fields, files = form.size, 0, dict(form.fields), dict(form.files)

    def report(done: int) -> None:
        if form.on_upload is not None:
            form.on_upload(before + done, total)

    for part, path in form.files.items():
        size = path.stat().st_size
        if size <= multipart.SMALL:
            continue
        digest = await in_thread(partial(sha256, path))
        upload_id = hashlib.sha256(f"{key}\n{part}\n{digest}".encode()).hexdigest()[:40]
        await upload(exchange, path, upload_id, digest=digest, report=report)
        del files[part]
        fields[f"{part}_upload"] = upload_id
        before += size
    return replace(form, fields=fields, files=files, before=before)


async def upload(exchange: Exchange, path: Path, upload_id: str, *, digest: str, report: Callable[[int], None]) -> None:
    """Upload a file, starting after the last stored byte.

    Each stored byte counts as success, so the client does not give up on a poor connection that makes progress.
    """
    attempts, size, reached = exchange.attempts, path.stat().st_size, 0
    known: Upload | None = None
    while True:
        held = known or await _state(exchange, upload_id)
        if held.complete:
            report(size)
            return
        if held.offset > reached:
            reached = held.offset
            attempts.succeeded()
        headers = {"Upload-Offset": str(held.offset), "Upload-Length": str(size), REPR_DIGEST: repr_digest(digest)}
        body = Remainder(path=path, offset=held.offset, report=report)
        call = Call(method="PUT", path=_path(upload_id), headers=headers, body=body)
        fault: Exception
        try:
            response = await exchange.send(call)
            if response.is_success:
                await read(response, attempts)
                await response.aclose()
                attempts.succeeded()
                return
            fault = await refusal(response, attempts)
        except httpx.TransportError as lost:
            fault = lost
        if isinstance(fault, APIStatusError) and (fault.code in OUT_OF_STEP or fault.problem.retryable):
            await async_sleep(attempts.pause_after(fault))
        else:
            await exchange.pause_or_raise(call, fault)
        # At a low rate limit, the request for the state would use up what was waited for.
        known = held if isinstance(fault, TooManyRequests) else None


async def delete_uploads(exchange: Exchange, form: Form) -> None:
    """Delete the uploads of a form that was submitted; uploads that remain, for example after the deadline, expire."""
    for name, upload_id in form.fields.items():
        if name.endswith("_upload"):
            with suppress(httpx.TransportError, PliantError):
                response = await exchange.send(Call(method="DELETE", path=_path(upload_id)))
                await response.aclose()


async def _state(exchange: Exchange, upload_id: str) -> Upload:
    """Return the state of an upload, which need not have begun. Does not count as success."""
    call = Call(method="GET", path=_path(upload_id))
    while True:
        try:
            async with exchange.stream(call) as response:
                return parse(Upload, await read(response, exchange.attempts), response.status_code)
        except NotFound as missing:
            if missing.code != "unknown_upload":
                raise
            return Upload(id=upload_id, offset=0, complete=False)
        except httpx.TransportError as lost:
            await exchange.pause_or_raise(call, lost)


def _path(upload_id: str) -> str:
    return f"/v1/uploads/{upload_id}"

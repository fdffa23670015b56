"""Sending large files ahead of their job: in raw bytes, gone on with where the connection broke."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import httpx
from pliant.client.download import sha256
from pliant.client.errors import NotFound, Refused, error_from
from pliant.client.flow import Call, Do, Flow, Open, Pause
from pliant.client.multipart import Form, Rest
from pliant.client.retry import Attempts
from pliant.client.transport import opened, parse, pause_or_raise, rest
from pliant.schemas.job import Upload

LARGE = 32 * 2**20
"""Bytes of a submission's files together above which they are sent ahead."""

SMALL = 2**20
"""Bytes of a file that goes along with the job all the same."""

OUT_OF_STEP = frozenset({"upload_offset_mismatch", "upload_busy", "upload_taken_over", "upload_complete"})
"""Codes that say: look where the upload stands, and go on from there."""


def sent_ahead(attempts: Attempts, form: Form, key: str) -> Flow[Form]:
    """Upload what is large, and return the form that names it instead of carrying it.

    Parameters
    ----------
    attempts : Attempts
        The tries of the whole submission.
    form : Form
        As it would be sent at once; returned as it is if it is small, or if the service has no uploads.
    key : str
        Of the submission: the same key and the same content find what an earlier run has sent.
    """
    if form.size <= LARGE:
        return form
    total, before, fields, files = form.size, 0, dict(form.fields), dict(form.files)

    def tell(done: int) -> None:
        if form.on_upload is not None:
            form.on_upload(before + done, total)

    for part, path in form.files.items():
        size = path.stat().st_size
        if size <= SMALL:
            continue
        digest = yield Do(partial(sha256, path))
        upload_id = hashlib.sha256(f"{key}\n{part}\n{digest}".encode()).hexdigest()[:40]
        if not (yield from upload(attempts, path, upload_id, sha256=digest, tell=tell)):
            return form
        del files[part]
        fields[f"{part}_upload"] = upload_id
        before += size
    return replace(form, fields=fields, files=files, before=before)


def upload(attempts: Attempts, path: Path, upload_id: str, *, sha256: str, tell: Callable[[int], None]) -> Flow[bool]:
    """Send a file, from where an earlier try or an earlier run has left off; return False if the service has no uploads.

    Each byte that arrives counts as success, so that a poor connection is never given up while it gets on.
    """
    size, reached = path.stat().st_size, 0
    digest = base64.b64encode(bytes.fromhex(sha256)).decode()
    while True:
        there = yield from _look(attempts, upload_id)
        if there is None:
            return False
        if there.complete:
            tell(size)
            return True
        if there.offset > reached:
            reached = there.offset
            attempts.succeeded()
        headers = {"Upload-Offset": str(there.offset), "Upload-Length": str(size), "Repr-Digest": f"sha-256=:{digest}:"}
        body = Rest(path=path, offset=there.offset, tell=tell)
        call = Call(method="PUT", path=_path(upload_id), headers=headers, body=body)
        fault: Exception
        try:
            head = yield Open(call, attempts.remaining())
            attempts.answered()
            answer = yield from rest()
            if head.status < 400:
                attempts.succeeded()
                return True
            fault = error_from(head.status, head.headers, answer)
        except httpx.TransportError as lost:
            fault = lost
        if isinstance(fault, Refused) and (fault.code in OUT_OF_STEP or fault.problem.retryable):
            yield Pause(attempts.pause_after(fault))
        else:
            yield from pause_or_raise(attempts, call, fault)


def removed(attempts: Attempts, form: Form) -> Flow[None]:
    """Remove the uploads that a form names, once the job has its own copy; what is left for any reason expires."""
    for name, upload_id in form.fields.items():
        if name.endswith("_upload"):
            with suppress(httpx.TransportError):
                yield Open(Call(method="DELETE", path=_path(upload_id)), attempts.remaining())
                yield from rest()


def _look(attempts: Attempts, upload_id: str) -> Flow[Upload | None]:
    """Return where an upload stands, None if the service knows no uploads. Not counted as success: nothing was sent."""
    call = Call(method="GET", path=_path(upload_id))
    while True:
        try:
            head = yield from opened(attempts, call)
            return parse(Upload, (yield from rest()), head)
        except NotFound as missing:
            return Upload(id=upload_id, offset=0, complete=False) if missing.code == "unknown_upload" else None
        except httpx.TransportError as lost:
            yield from pause_or_raise(attempts, call, lost)


def _path(upload_id: str) -> str:
    return f"/v1/uploads/{upload_id}"

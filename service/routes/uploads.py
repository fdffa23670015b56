"""Resumable uploads of large inputs as raw bytes; a job refers to an upload instead of containing the file.

The protocol is the IETF draft "Resumable Uploads for HTTP" (draft-ietf-httpbis-resumable-upload): the headers `Upload-Offset`,
`Upload-Complete`, `Upload-Length` and `Upload-Limit`; HEAD returns the offset, PATCH appends, DELETE removes, and 409 contains
the correct offset after a mismatch. Chosen over tus 1.0, which it is meant to replace, because a whole upload is one plain `PUT`
that any HTTP client can send (`curl -T`), and over numbered parts as in S3, because the offset is the only state.
Differences from the draft: the client chooses the id, as for jobs, so there is no interim response 104 to wait for; and a `PUT`
with `Upload-Offset` appends like PATCH, because it is idempotent and can be repeated after a lost response.
"""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import anyio
from anyio import to_thread
from fastapi import APIRouter, Header, Path, Request, Response
from pliant.schemas.digests import REPR_DIGEST, repr_digest
from pliant.schemas.job import Upload
from pliant.schemas.problems import ProblemCode
from pliant.service.dependencies import Bound, Bounds, Core, MyUploads, Service, bounds_of
from pliant.service.multipart import batches
from pliant.service.openapi import problems
from pliant.service.problems import Refusal, refused, wrong_input
from pliant.worker.errors import OffsetMismatch
from pliant.worker.uploads.service import Uploads
from pliant.worker.uploads.writer import Capacity, Writer

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])  # not `Router`: HEAD has an answer of its own

ANY = 2**62
MISMATCH = "https://iana.org/assignments/http-problem-types#mismatching-upload-offset"
Id = Annotated[
    str, Path(description="Any id of your own: 3 to 64 letters, digits, underscores or dashes.", examples=["take-3"])
]
Offset = Annotated[
    int | None,
    Header(
        alias="Upload-Offset",
        ge=0,
        le=ANY,
        description="Offset of the body's first byte; 0, the default, starts again.",
    ),
]
Complete = Annotated[
    Literal["?1", "?0"], Header(alias="Upload-Complete", description="`?0` if more follows; `?1` is the default.")
]
Length = Annotated[
    int | None, Header(alias="Upload-Length", ge=0, le=ANY, description="Bytes of the whole upload, if known.")
]
Digest = Annotated[
    str | None,
    Header(alias=REPR_DIGEST, max_length=500, description="`sha-256=:BASE64:` of the whole; checked at the end."),
]
_STATE = {
    "Upload-Offset": {"description": "Bytes received.", "schema": {"type": "integer"}},
    "Upload-Complete": {"description": "`?1` when complete.", "schema": {"type": "string"}},
    "Upload-Limit": {"description": "Largest upload, and its lifetime in seconds.", "schema": {"type": "string"}},
}
_BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}
_ERRORS = problems(400, 401, 403, 404, 408, 409, 413, 415, 422, 429, 503, 507)

_DIGEST = re.compile(r"([a-z*][a-z0-9_.*-]*)=:([A-Za-z0-9+/=]*):")
"""A member of a Repr-Digest: a byte sequence in a dictionary of structured fields (RFC 8941)."""


@router.put(
    "/{id}",
    status_code=201,
    operation_id="put_upload",
    summary="Upload a large input, or resume",
    responses={
        201: {"headers": _STATE},
        200: {"model": Upload, "description": "Resumed, or already complete."},
        **_ERRORS,
    },
    openapi_extra=_BODY,
)
async def put(
    id: Id,
    request: Request,
    response: Response,
    core: Core,
    bounds: Bound,
    uploads: MyUploads,
    offset: Offset = None,
    complete: Complete = "?1",
    length: Length = None,
    digest: Digest = None,
) -> Upload:
    """Upload a file as raw bytes. A job then refers to it by `tracks_upload=ID` instead of containing the part `tracks`.

    After an interruption, get the offset with HEAD and send the rest with `Upload-Offset`. Only a complete upload can be used.
    It is removed one day after its last byte or last use, unless the operator chose another period.
    """
    if "content-range" in request.headers:  # as `curl -C` sends it; the body would replace what is there
        detail = "An upload is not resumed with Content-Range. Send the rest with Upload-Offset, the offset that HEAD returns."
        raise Refusal(ProblemCode.BAD_REQUEST, detail=detail, field="Content-Range")
    sending = Sending.of(request, offset=offset or 0, complete=complete, length=length, digest=digest)
    there = await _find_complete(uploads, id, sending)
    response.status_code = 200 if there is not None or sending.offset > 0 else 201
    if there is None:
        async with core.upload_locks.take((uploads.owner, id)):
            await _receive(request, core, uploads=uploads, id=id, sending=sending)
        there = await to_thread.run_sync(uploads.get, id)
    _describe(response, there, bounds, uploads)
    response.headers["Location"] = f"/v1/uploads/{id}"
    return there


@router.patch(
    "/{id}",
    operation_id="append_upload",
    summary="Append to an upload",
    responses={200: {"headers": _STATE}, **_ERRORS},
    openapi_extra=_BODY,
)
async def patch(
    id: Id,
    request: Request,
    response: Response,
    core: Core,
    bounds: Bound,
    uploads: MyUploads,
    offset: Annotated[int, Header(alias="Upload-Offset", ge=0, le=ANY)],
    complete: Complete = "?1",
    length: Length = None,
    digest: Digest = None,
) -> Upload:
    """Append at `Upload-Offset`, as the IETF draft specifies. `PUT` does the same, but at 0 it replaces what was uploaded."""
    if offset == 0:  # `PUT` would discard what is there, or begin an upload
        there = await to_thread.run_sync(uploads.get, id)
        if there.offset > 0 and not there.complete:
            raise _mismatch(OffsetMismatch(id, expected=there.offset, got=0))
        length = there.length if length is None else length
    there = await put(id, request, response, core, bounds, uploads, offset, complete, length, digest)
    response.status_code = 200
    return there


@router.head(
    "/{id}",
    status_code=204,
    operation_id="get_upload_offset",
    summary="Get the offset of an upload",
    responses={204: {"headers": _STATE}, **problems(401, 404)},
)
def head(id: Id, response: Response, bounds: Bound, uploads: MyUploads) -> None:
    """Return `Upload-Offset`, where to resume, and `Upload-Complete`."""
    _describe(response, uploads.get(id), bounds, uploads)


@router.get(
    "/{id}",
    operation_id="get_upload",
    summary="Get an upload",
    responses={200: {"headers": _STATE}, **problems(401, 404)},
)
def get(id: Id, response: Response, bounds: Bound, uploads: MyUploads) -> Upload:
    """Return the bytes received, the expiry date, and the SHA-256 of a complete upload."""
    there = uploads.get(id)
    _describe(response, there, bounds, uploads)
    return there


@router.delete(
    "/{id}",
    status_code=204,
    operation_id="delete_upload",
    summary="Delete an upload",
    responses=problems(401, 403, 404, 409),
)
async def delete(id: Id, core: Core, uploads: MyUploads) -> None:
    """Delete an upload, complete or not. Jobs that used it keep their own copy."""
    async with core.upload_locks.take((uploads.owner, id)):
        await to_thread.run_sync(uploads.delete, id)


@dataclass(frozen=True, kw_only=True)
class Sending:
    """The position of one request's body in the upload, from its headers."""

    offset: int
    last: bool
    """This body is the last one."""
    length: int | None
    """Bytes of the whole upload, if known."""
    sha256: str | None
    """Digest of the whole upload, if given."""

    @classmethod
    def of(cls, request: Request, *, offset: int, complete: str, length: int | None, digest: str | None) -> Sending:
        """Read the headers; the length of the last body determines the length of the whole upload."""
        last, body = complete == "?1", request.headers.get("content-length", "")
        if length is None and last and body.isdecimal():
            length = offset + int(body)
        return cls(offset=offset, last=last, length=length, sha256=_sha256(digest))


async def _receive(request: Request, core: Service, *, uploads: Uploads, id: str, sending: Sending) -> None:
    """Write the body as it arrives. If it is interrupted, the bytes received are kept, and the client resumes after them."""
    capacity = await to_thread.run_sync(partial(_capacity, core, bounds_of(request)))
    held = uploads.write(id, offset=sending.offset, length=sending.length, capacity=capacity)
    try:
        writer: Writer = await to_thread.run_sync(held.__enter__)
    except OffsetMismatch as error:
        raise _mismatch(error) from error
    try:
        # The writer enforces the limit, over all requests together.
        async for batch in batches(request, max_bytes=ANY, stall_seconds=core.settings.stall_seconds):
            await to_thread.run_sync(writer.write, batch)
        if sending.last:
            await to_thread.run_sync(partial(writer.finish, sha256=sending.sha256))
    finally:
        with anyio.CancelScope(shield=True):  # a request that a newer one stops must still release the lock
            await to_thread.run_sync(held.__exit__, None, None, None)


def _mismatch(error: OffsetMismatch) -> Refusal:
    return refused(error, type=MISMATCH, headers={"Upload-Offset": error.expected, "Upload-Complete": "?0"})


def _capacity(core: Service, bounds: Bounds) -> Capacity:
    quota = core.jobs.settings.disk_quota
    return Capacity(max_bytes=bounds.max_upload_bytes, quota=quota, used=core.jobs.used() if quota > 0 else 0)


async def _find_complete(uploads: Uploads, id: str, sending: Sending) -> Upload | None:
    """Return the complete upload if it equals the body: the client repeats a request whose response was lost."""
    if sending.sha256 is None or sending.offset > 0:
        return None
    there = await to_thread.run_sync(uploads.find, id)
    return there if there is not None and there.sha256 == sending.sha256 else None


def _sha256(digest: str | None) -> str | None:
    """Return the SHA-256 of a Repr-Digest (RFC 9530) in hexadecimal; None without one. Other algorithms are ignored.

    Raises
    ------
    Refusal
        The digest is malformed.
    """
    if digest is None:
        return None
    members = [_DIGEST.fullmatch(member.strip()) for member in digest.split(",")]
    given = [member[2] for member in members if member is not None and member[1] == "sha-256"]
    if not given and None not in members:
        return None
    try:
        value = base64.b64decode(given[-1], validate=True) if given else b""
    except ValueError:  # not base64
        value = b""
    if len(value) != 32:
        expected, got, hint = "sha-256=:BASE64 of 32 bytes:", digest[:80], "Encode the raw digest, or leave it out."
        code = ProblemCode.INVALID_DIGEST
        raise wrong_input(code, field=REPR_DIGEST, expected=expected, got=got, hint=hint)
    return value.hex()


def _describe(response: Response, upload: Upload, bounds: Bounds, uploads: Uploads) -> None:
    headers = response.headers
    headers["Upload-Offset"] = str(upload.offset)
    headers["Upload-Complete"] = "?1" if upload.complete else "?0"
    if upload.length is not None:
        headers["Upload-Length"] = str(upload.length)
    age = f", max-age={int(uploads.expiry)}" if uploads.expiry > 0 else ""
    headers["Upload-Limit"] = f"max-size={bounds.max_upload_bytes}{age}"
    if upload.sha256 is not None:
        headers[REPR_DIGEST] = repr_digest(upload.sha256)

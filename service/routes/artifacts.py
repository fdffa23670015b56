"""Result files: the list, and each by name, whole or in part."""

from __future__ import annotations

import base64
from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.responses import Response, StreamingResponse
from pliant.schemas.job import Artifact
from pliant.service.dependencies import Mine
from pliant.service.openapi import problems
from pliant.service.problems import Refusal
from pliant.service.ranges import decide
from pliant.service.routes.jobs import Id

router = APIRouter(prefix="/v1/jobs/{id}/artifacts", tags=["artifacts"])

Name = Annotated[str, Path(description="A file of the job.", examples=["shapes.npz"])]
_BYTES = {"*/*": {"schema": {"type": "string", "format": "binary"}}}


@router.get("", summary="List a job's files", responses=problems(401, 404, 503))
def artifacts(id: Id, jobs: Mine) -> list[Artifact]:
    """Return name, media type, size and SHA-256 of every file; empty until the job has succeeded."""
    return jobs.get(id).artifacts


@router.head("/{name}", include_in_schema=False)
@router.get(
    "/{name}",
    summary="Download a file",
    response_class=StreamingResponse,
    responses={
        200: {"description": "The whole file, in its own media type.", "content": _BYTES},
        206: {"description": "The part that `Range` asked for.", "content": _BYTES},
        304: {"description": "The client has this file (`If-None-Match`)."},
        **problems(401, 404, 412, 416, 503),
    },
)
def artifact(id: Id, name: Name, request: Request, jobs: Mine) -> Response:
    """Return a file. `Range` with `If-Range` resumes a download; `ETag` and `Repr-Digest` are its SHA-256."""
    about, blob = jobs.artifact(id, name)
    size = blob.size
    etag = f'"{about.sha256}"'
    part = decide(request.headers, size=size, etag=etag)
    headers = {
        "ETag": etag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",  # kept, but asked for again each time: the token may have been revoked
    }
    if part.status == 412:
        detail = "The file is not the one that If-Match names. Download it anew, without that header."
        raise Refusal(412, "precondition_failed", detail=detail, headers=headers)
    if part.status == 416:
        detail = f"The file has {size} bytes, and the range asked for lies outside. Ask for a range within, or none."
        got = request.headers["range"][:80]
        raise Refusal(
            416,
            "range_not_satisfiable",
            detail=detail,
            field="Range",
            expected=f"within 0–{size}",
            got=got,
            headers={**headers, "Content-Range": f"bytes */{size}"},
        )
    if part.status == 304:
        return Response(status_code=304, headers=headers)
    headers |= {
        "Content-Length": str(part.length),
        "Content-Disposition": f'attachment; filename="{about.name}"',
        "Repr-Digest": f"sha-256=:{base64.b64encode(bytes.fromhex(about.sha256)).decode()}:",
    }
    if part.status == 206:
        headers["Content-Range"] = f"bytes {part.start}-{part.start + part.length - 1}/{size}"
    if request.method == "HEAD":
        return Response(status_code=part.status, headers=headers, media_type=about.media_type)
    body = blob.read(part.start, part.start + part.length)
    return StreamingResponse(body, status_code=part.status, headers=headers, media_type=about.media_type)

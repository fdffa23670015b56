"""Result files: list them, and download each by name, completely or in byte ranges."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Annotated

from fastapi import Path, Query, Request
from fastapi.responses import RedirectResponse, Response, StreamingResponse
from pliant.schemas.digests import REPR_DIGEST, repr_digest
from pliant.schemas.job import Artifact
from pliant.schemas.problems import ProblemCode
from pliant.service.dependencies import Core, Mine
from pliant.service.openapi import problems
from pliant.service.problems import Refusal
from pliant.service.ranges import Slice, decide
from pliant.service.routes.jobs import Id
from pliant.service.routes.router import Router
from pliant.worker.jobs.service import Jobs
from pliant.worker.store.blobs import Blob

router = Router(prefix="/v1/jobs/{id}/artifacts", tags=["artifacts"])

Name = Annotated[str, Path(description="A file of the job.", examples=["shapes.npz"])]
Redirect = Annotated[
    bool, Query(description="The client follows a redirect to the object store, without its `Authorization` header.")
]
LINK_SECONDS = 300.0
"""Seconds for which a redirect to the object store can be followed; the transfer itself may take longer."""

_BINARY = {"schema": {"type": "string", "format": "binary"}}
# Client generators use the first; the list of files has the media type of each.
_BYTES = {"application/octet-stream": _BINARY, "*/*": _BINARY}


@router.get("", operation_id="list_artifacts", summary="List a job's files", responses=problems(401, 404, 503))
def artifacts(id: Id, jobs: Mine) -> list[Artifact]:
    """Return name, media type, size and SHA-256 of every file; empty until the job has succeeded."""
    return jobs.get(id).artifacts


@router.get(
    "/{name}",
    operation_id="get_artifact",
    summary="Download a file",
    response_class=StreamingResponse,
    responses={
        200: {"description": "The whole file, in its own media type.", "content": _BYTES},
        206: {"description": "The bytes that `Range` names.", "content": _BYTES},
        304: {"description": "The client has this file (`If-None-Match`)."},
        307: {"description": "With `redirect=true`: the file is at `Location`, in the object store, for five minutes."},
        **problems(401, 404, 410, 412, 416, 503),
    },
)
def artifact(id: Id, name: Name, request: Request, jobs: Mine, core: Core, redirect: Redirect = False) -> Response:
    """Return a file. `Range` with `If-Range` resumes a download; `ETag` and `Repr-Digest` are its SHA-256.

    With `redirect=true` a service that stores files in S3 may return 307 with a presigned URL: send `Range` to it, too, but neither
    `If-Range` nor `Authorization`. Otherwise, and with HEAD, because the URL is signed for GET, the parameter has no effect.
    """
    about, blob = _open(jobs, id, name)
    size = blob.size
    etag = f'"{about.sha256}"'
    part = decide(request.headers, size=size, etag=etag, ranges=request.method == "GET")
    headers = {
        "ETag": etag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",  # cached, but revalidated each time: the token may have been revoked
    }
    if part.status == 412:
        detail = "The file is not the one that If-Match names. Download it again, without that header."
        raise Refusal(ProblemCode.PRECONDITION_FAILED, detail=detail, headers=headers)
    if part.status == 416:
        detail = f"The requested range lies outside the file's {size} bytes. Ask for a range inside it, or for none."
        got = request.headers["range"][:80]
        raise Refusal(
            ProblemCode.RANGE_NOT_SATISFIABLE,
            detail=detail,
            field="Range",
            expected=f"within 0–{size}",
            got=got,
            headers={**headers, "Content-Range": f"bytes */{size}"},
        )
    if part.status == 304:
        return Response(status_code=304, headers=headers)
    if redirect and core.settings.presigned_redirects and (link := _link(blob, part, request)) is not None:
        return RedirectResponse(link, 307, headers={**headers, "Cache-Control": "private, no-store"})
    headers |= {
        "Content-Length": str(part.length),
        "Content-Disposition": f'attachment; filename="{about.name}"',
        REPR_DIGEST: repr_digest(about.sha256),
    }
    if part.status == 206:
        headers["Content-Range"] = f"bytes {part.start}-{part.start + part.length - 1}/{size}"
    if request.method == "HEAD":
        return Response(status_code=part.status, headers=headers, media_type=about.media_type)
    body = _begin(blob.read(part.start, part.start + part.length), jobs, id, name)
    return StreamingResponse(body, status_code=part.status, headers=headers, media_type=about.media_type)


def _link(blob: Blob, part: Slice, request: Request) -> str | None:
    """Return the file's URL in the object store, or None if the service must respond itself.

    The store does not know the file's SHA-256, so it cannot ignore a `Range` because of `If-Range`, as the service does.
    """
    ignored = "range" in request.headers and part.status != 206
    return None if request.method == "HEAD" or ignored else blob.link(seconds=LINK_SECONDS)


def _open(jobs: Jobs, id: str, name: str) -> tuple[Artifact, Blob]:
    """Return a file's description and its bytes; raise `Refusal` (410) if the file was deleted meanwhile."""
    try:
        return jobs.artifact(id, name)
    except FileNotFoundError:
        raise _gone(jobs, id, name) from None


def _begin(body: Iterator[bytes], jobs: Jobs, id: str, name: str) -> Iterator[bytes]:
    """Read the first chunk now, while a status code can still report that the file is gone."""
    try:
        first = next(body, b"")
    except FileNotFoundError:
        raise _gone(jobs, id, name) from None
    return chain([first], body)


def _gone(jobs: Jobs, id: str, name: str) -> Refusal:
    """Return the refusal of a file whose bytes are gone; raises `UnknownJob` if the job is, too."""
    jobs.get(id)
    detail = f"The file {name!r} of job {id!r} was deleted. Submit the inputs again if the result is still needed."
    return Refusal(ProblemCode.ARTIFACT_GONE, detail=detail)

"""Share links of a job: create, list, revoke."""

from __future__ import annotations

from typing import Annotated

from anyio import to_thread
from fastapi import Path, Request
from pliant.schemas.shares import Share, ShareRequest
from pliant.service.dependencies import Mine
from pliant.service.openapi import problems
from pliant.service.routes.jobs import Id
from pliant.service.routes.json_body import body_of, read_json
from pliant.service.routes.router import Router
from pliant.worker.jobs.sharing import create_share, list_shares, revoke_share

router = Router(prefix="/v1/jobs/{id}/shares", tags=["artifacts"])


@router.post(
    "",
    status_code=201,
    operation_id="create_share",
    summary="Create a share link",
    responses=problems(400, 401, 403, 404, 408, 409, 413, 415, 422, 429, 503),
    openapi_extra=body_of(ShareRequest, required=False),
)
async def create(id: Id, request: Request, jobs: Mine) -> Share:
    """Create a read-only link to one job's results, valid until it expires or is revoked.

    Anyone with the link can read the job's record and its files, but no log and no other job, and can change nothing. Send the
    token as `Authorization: Bearer share.…`, even if the service requires no tokens. It is returned only once; the service
    stores only its digest.
    """
    wanted = await read_json(request, ShareRequest)
    return await to_thread.run_sync(lambda: create_share(jobs, id, wanted))


@router.get("", operation_id="list_shares", summary="List share links", responses=problems(401, 403, 404, 503))
def shares(id: Id, request: Request, jobs: Mine) -> list[Share]:
    """Return the valid links of a job, without their tokens. A request through a share link gets only that link."""
    own = request.scope.get("pliant.share")
    return [each for each in list_shares(jobs, id) if own in (None, each.id)]


@router.delete(
    "/{share}",
    status_code=204,
    operation_id="revoke_share",
    summary="Revoke a share link",
    responses=problems(401, 403, 404, 503),
)
def revoke(id: Id, share: Annotated[str, Path(description="The link's id.", max_length=64)], jobs: Mine) -> None:
    """Revoke a link immediately."""
    revoke_share(jobs, id, share)

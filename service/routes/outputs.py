"""Further files of a finished job, written from its stored result."""

from __future__ import annotations

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from pliant.schemas.job import Job
from pliant.schemas.outputs import OutputRequest
from pliant.service.dependencies import Mine
from pliant.service.openapi import problems
from pliant.service.routes.jobs import LOCATION, Id, Key
from pliant.service.routes.json_body import body_of, read_json
from pliant.worker.jobs.further_outputs import make_outputs

router = APIRouter(prefix="/v1/jobs/{id}/outputs", tags=["jobs"])


@router.post(
    "",
    status_code=202,
    operation_id="make_outputs",
    summary="Write further files of a result",
    responses={
        202: {"headers": LOCATION},
        200: {"model": Job, "description": "An earlier, equal request created this job."},
        **problems(400, 401, 403, 404, 409, 413, 415, 422, 429, 503, 507),
    },
    openapi_extra=body_of(OutputRequest, required=True),
)
async def outputs(id: Id, request: Request, response: Response, jobs: Mine, key: Key) -> Job:
    """Queue a job that writes further files of a result, e.g. USD or another frame rate, without solving again.

    Follow and download it like any other job; its `outputs_of` is the id of the original job. It has its own copy of the data, so
    the original job can be deleted. Repeating the request returns the same job with 200, unless that job failed or was cancelled.
    """
    wanted = await read_json(request, OutputRequest)
    job, new = await to_thread.run_sync(lambda: make_outputs(jobs, id, wanted, idempotency_key=key))
    response.status_code = 202 if new else 200
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job

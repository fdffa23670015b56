"""Jobs: submit, look at, list, cancel, run again, delete."""

from __future__ import annotations

import re
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Header, Path, Query, Request, Response
from pliant.schemas.job import Job, JobPage, Status
from pliant.service.dependencies import Bound, Bounds, Core, Mine, Service, my_uploads
from pliant.service.multipart import receive_form
from pliant.service.openapi import JOB_EXAMPLE, SUBMIT_BODY, problems
from pliant.service.submission import accept, form_rules
from pliant.worker.jobs.service import LARGEST_PAGE, Jobs

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

Id = Annotated[str, Path(description="The job's id.", examples=["4f0c6b1d2a9e8c7b5d3f"])]
Key = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        max_length=255,
        description="Any text of your own, e.g. a UUID. The same key with the same content returns the first job.",
    ),
]
Prefer = Annotated[
    str | None,
    Header(description="`wait=20` answers when the job has ended, or after 20 s, whichever comes first."),
]
_WAIT = re.compile(r"\s*wait\s*=\s*(\d{1,6})\s*", re.IGNORECASE)
_SUBMIT_ERRORS = problems(400, 401, 403, 408, 409, 413, 415, 422, 429, 503, 507)
_LOCATION = {"Location": {"description": "The job's address.", "schema": {"type": "string"}}}


@router.post(
    "",
    status_code=202,
    summary="Submit a job",
    responses={202: {"headers": _LOCATION, "content": JOB_EXAMPLE}, **_SUBMIT_ERRORS},
    openapi_extra={"requestBody": SUBMIT_BODY},
)
async def submit(
    request: Request, response: Response, core: Core, jobs: Mine, bounds: Bound, key: Key = None, prefer: Prefer = None
) -> Job:
    """Read the tracks and whatever comes with them, check them, and queue the job.

    An answer of 202 is a promise: the job is stored and will end with a result or a reason, whatever is killed meanwhile.
    Any other answer means that nothing was queued and nothing kept.
    """
    job, _ = await _receive(request, core, jobs, bounds, idempotency_key=key)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return await _waited(job, core, jobs, prefer, response)


@router.put(
    "/{id}",
    status_code=202,
    summary="Submit a job under your own id",
    responses={
        202: {"headers": _LOCATION, "content": JOB_EXAMPLE},
        200: {"model": Job, "description": "The same request made this job before."},
        **_SUBMIT_ERRORS,
    },
    openapi_extra={"requestBody": SUBMIT_BODY},
)
async def put(
    id: Id, request: Request, response: Response, core: Core, jobs: Mine, bounds: Bound, prefer: Prefer = None
) -> Job:
    """Do as `POST` does, under an id that you choose: 3 to 64 letters, digits, underscores or dashes.

    Repeating the request is safe: the same content returns the same job with 200, other content is refused with 409.
    """
    job, new = await _receive(request, core, jobs, bounds, id=id)
    response.status_code = 202 if new else 200
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return await _waited(job, core, jobs, prefer, response)


@router.get("", summary="List jobs", responses=problems(401, 422, 503))
def page(
    jobs: Mine,
    cursor: Annotated[str | None, Query(description="`next` of the page before.", max_length=200)] = None,
    limit: Annotated[int, Query(ge=1, le=LARGEST_PAGE, description="Jobs on a page.")] = 50,
    status: Annotated[list[Status] | None, Query(description="Only these; may be given several times.")] = None,
) -> JobPage:
    """Return your jobs, newest first."""
    return jobs.page(cursor=cursor, limit=limit, statuses=status)


@router.get("/{id}", summary="Look at a job", responses={200: {"content": JOB_EXAMPLE}, **problems(401, 404, 422, 503)})
async def get(id: Id, response: Response, core: Core, jobs: Mine, prefer: Prefer = None) -> Job:
    """Return everything known of a job: status, progress, place in the queue, metrics, files, or why it failed."""
    job = await to_thread.run_sync(jobs.get, id)
    return await _waited(job, core, jobs, prefer, response)


@router.post("/{id}/cancel", summary="Cancel a job", responses=problems(401, 403, 404, 409, 503))
def cancel(id: Id, jobs: Mine) -> Job:
    """Ask a job to end. A queued one is cancelled at once; a running one stops at its next step."""
    return jobs.cancel(id)


@router.post(
    "/{id}/retry",
    status_code=202,
    summary="Run a failed or cancelled job again",
    responses={202: {"headers": _LOCATION}, **problems(401, 403, 404, 409, 422, 429, 503, 507)},
)
def retry(id: Id, response: Response, jobs: Mine, key: Key = None) -> Job:
    """Queue a new job with the same inputs, options and name; `retry_of` names the old one."""
    job = jobs.retry(id, idempotency_key=key)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


@router.delete("/{id}", status_code=204, summary="Delete a finished job", responses=problems(401, 403, 404, 409, 503))
def delete(id: Id, jobs: Mine) -> None:
    """Remove a finished job with all its files."""
    jobs.delete(id)


async def _receive(
    request: Request,
    core: Service,
    jobs: Jobs,
    bounds: Bounds,
    *,
    id: str | None = None,
    idempotency_key: str | None = None,
) -> tuple[Job, bool]:
    """Receive a form into a room of its own and submit what it holds; the room is gone afterwards, whatever happened."""
    rules = form_rules(core.settings, max_body_bytes=bounds.max_body_bytes)
    await to_thread.run_sync(lambda: jobs.check_capacity(id=id, idempotency_key=idempotency_key))
    with core.incoming.room() as room:
        form = await receive_form(request, room, rules=rules)
        return await core.parsing.run(
            jobs.owner or "",
            lambda: accept(
                form,
                room,
                jobs=jobs,
                uploads=my_uploads(request),
                limits=core.limits,
                id=id,
                idempotency_key=idempotency_key,
            ),
        )


async def _waited(job: Job, core: Service, jobs: Jobs, prefer: str | None, response: Response) -> Job:
    """Return the job as it is once it has ended or the client's patience has, whichever comes first."""
    wish = next(filter(None, (_WAIT.fullmatch(part) for part in (prefer or "").split(","))), None)
    if wish is None:
        return job
    seconds = min(int(wish[1]), core.settings.max_wait_seconds)
    response.headers["Preference-Applied"] = f"wait={seconds}"
    return await core.followers.wait(jobs, job.id, seconds)

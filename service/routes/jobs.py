"""Jobs: submit, get, list, cancel, retry, delete."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Annotated

from anyio import to_thread
from fastapi import Depends, Header, Path, Query, Request, Response
from pliant.schemas.job import LARGEST_PAGE, LONGEST_KEY, Job, JobPage, Status
from pliant.schemas.problems import ProblemCode
from pliant.service.dependencies import Bound, Bounds, Core, Mine, Service, my_uploads
from pliant.service.multipart import receive_form
from pliant.service.openapi import JOB_EXAMPLE, SUBMIT_BODY, problems
from pliant.service.problems import Refusal
from pliant.service.routes.router import Router
from pliant.service.submission import accept, form_rules
from pliant.worker.errors import StoreUnavailable, UnknownJob
from pliant.worker.jobs.retry import retry as run_again
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.validation import check_key
from pydantic import WithJsonSchema

router = Router(prefix="/v1/jobs", tags=["jobs"])

Id = Annotated[str, Path(description="The job's id.", examples=["4f0c6b1d2a9e8c7b5d3f"])]
_KeyHeader = Annotated[
    Annotated[str, WithJsonSchema({"type": "string", "maxLength": LONGEST_KEY})] | None,
    Header(
        alias="Idempotency-Key",
        description="Any text of your own, e.g. a UUID. The same key with the same content returns the first job.",
    ),
]


async def idempotency_key(request: Request, key: _KeyHeader = None) -> str | None:
    """Return the `Idempotency-Key`, as UTF-8 if it is; several are refused, because each could stand for another job."""
    if len(request.headers.getlist("idempotency-key")) > 1:
        detail = "The header Idempotency-Key was sent more than once. Send one key."
        raise Refusal(ProblemCode.CONFLICTING_HEADERS, detail=detail, field="Idempotency-Key")
    if key is None:
        return None
    with suppress(UnicodeDecodeError):
        key = key.encode("latin-1").decode()  # ASGI decodes headers as Latin-1
    check_key(key)
    return key


Key = Annotated[str | None, Depends(idempotency_key)]


async def preferences(
    request: Request,
    prefer: Annotated[
        str | None,
        Header(description="`wait=20` answers when the job has ended, or after 20 s, whichever comes first."),
    ] = None,
) -> str | None:
    """Return the request's preferences; they may be spread over several headers of the name."""
    return None if prefer is None else ",".join(request.headers.getlist("Prefer"))


Prefer = Annotated[str | None, Depends(preferences)]
_WAIT = re.compile(r"\s*wait\s*=\s*(\d{1,15})\s*", re.IGNORECASE)
_SUBMIT_ERRORS = problems(400, 401, 403, 404, 408, 409, 413, 415, 422, 429, 503, 507)
LOCATION = {"Location": {"description": "The job's address.", "schema": {"type": "string"}}}


@router.post(
    "",
    status_code=202,
    operation_id="submit_job",
    summary="Submit a job",
    responses={202: {"headers": LOCATION, "content": JOB_EXAMPLE}, **_SUBMIT_ERRORS},
    openapi_extra={"requestBody": SUBMIT_BODY},
)
async def submit(
    request: Request, response: Response, core: Core, jobs: Mine, bounds: Bound, key: Key, prefer: Prefer = None
) -> Job:
    """Read and validate the inputs, and queue the job.

    After 202 the job is stored durably: it ends with a result or an error even if processes are killed meanwhile.
    After any other status nothing is queued or stored.
    """
    job, _ = await _receive(request, core, jobs, bounds, idempotency_key=key)
    return await _accepted(job, core, jobs, prefer, response)


@router.put(
    "/{id}",
    status_code=202,
    operation_id="put_job",
    summary="Submit a job under your own id",
    responses={
        202: {"headers": LOCATION, "content": JOB_EXAMPLE},
        200: {"model": Job, "description": "An earlier, equal request created this job."},
        **_SUBMIT_ERRORS,
    },
    openapi_extra={"requestBody": SUBMIT_BODY},
)
async def put(
    id: Id,
    request: Request,
    response: Response,
    core: Core,
    jobs: Mine,
    bounds: Bound,
    key: Key,
    prefer: Prefer = None,
) -> Job:
    """Submit a job under an id that you choose: 3 to 64 letters, digits, underscores or dashes.

    Repeating the request is safe: the same content returns the same job with 200, other content is refused with 409.
    """
    job, new = await _receive(request, core, jobs, bounds, id=id, idempotency_key=key)
    response.status_code = 202 if new else 200
    return await _accepted(job, core, jobs, prefer, response)


@router.get("", operation_id="list_jobs", summary="List jobs", responses=problems(401, 422, 503))
def page(
    jobs: Mine,
    cursor: Annotated[str | None, Query(description="`next` of the previous page.", max_length=200)] = None,
    limit: Annotated[
        int, Query(description="Jobs on a page.", json_schema_extra={"minimum": 1, "maximum": LARGEST_PAGE})
    ] = 50,
    status: Annotated[list[Status] | None, Query(description="Only jobs with this status; can be repeated.")] = None,
) -> JobPage:
    """Return your jobs, newest first."""
    return jobs.page(cursor=cursor, limit=limit, statuses=status)


@router.get(
    "/{id}",
    operation_id="get_job",
    summary="Get a job",
    responses={200: {"content": JOB_EXAMPLE}, **problems(401, 404, 422, 503)},
)
async def get(id: Id, response: Response, core: Core, jobs: Mine, prefer: Prefer = None) -> Job:
    """Return a job: status, progress, position in the queue, metrics and files, or the reason for its failure."""
    job = await to_thread.run_sync(jobs.get, id)
    return await _waited(job, core, jobs, prefer, response)


@router.post(
    "/{id}/cancel", operation_id="cancel_job", summary="Cancel a job", responses=problems(401, 403, 404, 409, 503)
)
def cancel(id: Id, jobs: Mine) -> Job:
    """Cancel a job. A queued job ends immediately, a running one at its next iteration."""
    return jobs.cancel(id)


@router.post(
    "/{id}/retry",
    status_code=202,
    operation_id="retry_job",
    summary="Run a failed or cancelled job again",
    responses={202: {"headers": LOCATION}, **problems(401, 403, 404, 409, 422, 429, 503, 507)},
)
def retry(id: Id, response: Response, jobs: Mine, key: Key) -> Job:
    """Queue a new job with the same inputs, options and name; its `retry_of` is the id of the old one."""
    job = run_again(jobs, id, idempotency_key=key)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


@router.delete(
    "/{id}",
    status_code=204,
    operation_id="delete_job",
    summary="Delete a finished job",
    responses=problems(401, 403, 404, 409, 503),
)
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
    """Receive a form into a scratch directory and submit the job; the directory is always removed."""
    rules = form_rules(core.settings, max_body_bytes=bounds.max_body_bytes)
    await to_thread.run_sync(lambda: jobs.check_capacity(id=id, idempotency_key=idempotency_key))
    async with core.incoming.scratch() as folder:
        form = await receive_form(request, folder, rules=rules)
        return await core.parsing.run(
            jobs.owner or "",
            lambda: accept(
                form,
                folder,
                jobs=jobs,
                uploads=my_uploads(request),
                limits=core.limits,
                id=id,
                idempotency_key=idempotency_key,
            ),
        )


async def _accepted(job: Job, core: Service, jobs: Jobs, prefer: str | None, response: Response) -> Job:
    """Return a submitted job, after the wait that `Prefer` requests.

    If the wait fails, return the job as it was accepted: it is stored, and an error would suggest that it is not.
    """
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    try:
        return await _waited(job, core, jobs, prefer, response)
    except (StoreUnavailable, UnknownJob):
        return job


async def _waited(job: Job, core: Service, jobs: Jobs, prefer: str | None, response: Response) -> Job:
    """Return the job when it has ended, or after the seconds of `Prefer: wait`, whichever comes first."""
    wish = next(filter(None, (_WAIT.fullmatch(part) for part in (prefer or "").split(","))), None)
    if wish is None:
        return job
    seconds = min(int(wish[1]), core.settings.max_wait_seconds)
    response.headers["Preference-Applied"] = f"wait={seconds}"
    return await core.followers.wait(jobs, job.id, seconds)

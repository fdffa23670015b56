"""The operations of a service, one function each; `AsyncClient` calls them with an `Exchange`."""

from __future__ import annotations

import json
import secrets
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping, Sequence
from contextlib import aclosing
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pliant.client._async.download import download
from pliant.client._async.events import follow
from pliant.client._async.transport import Exchange, parse
from pliant.client._async.upload import delete_uploads, upload_large
from pliant.client.call import Call
from pliant.client.errors import InvalidRequest, NotFound
from pliant.client.multipart import Inputs, OnBytes, checked_options
from pliant.client.pauses import async_sleep, in_thread
from pliant.client.result import job_path, unknown_file
from pliant.schemas.job import Interpretation, Job, JobPage, ServiceLimits, Status
from pliant.schemas.options import Options
from pliant.schemas.outputs import OutputRequest
from pliant.schemas.shares import Share, ShareRequest

OnJob = Callable[[Job], None]
"""Called with the job each time its record changes."""

JSON = "application/json"


async def submit(
    exchange: Exchange,
    inputs: Inputs,
    *,
    folder: Path,
    options: Options | Mapping[str, Any] | None,
    name: str,
    job_id: str | None,
    idempotency_key: str | None,
    webhook: str | None,
    webhook_secret: str | None,
    priority: str,
    on_upload: OnBytes | None,
) -> Job:
    """Submit inputs and return the new job. Temporary files are written to `folder`, which the caller removes."""
    texts = {
        "name": name, "webhook": webhook or "", "webhook_secret": webhook_secret or "",
        "priority": "" if priority == "normal" else priority,  # a service that does not know it accepts the usual one
    }  # fmt: skip
    fields = _fields(options) | {key: text for key, text in texts.items() if text != ""}
    whole = await in_thread(partial(inputs.form, folder, fields, on_upload))
    key = idempotency_key if idempotency_key is not None else secrets.token_urlsafe(16)
    for attempt in (1, 2, 3):
        form = await upload_large(exchange, whole, key if job_id is None else f"id:{job_id}")
        call = Call(
            method="POST" if job_id is None else "PUT",
            path="/v1/jobs" if job_id is None else job_path(job_id),
            headers={"Idempotency-Key": key} if job_id is None else {},
            form=form,
        )
        try:
            job = await exchange.record(call, Job)
        except InvalidRequest as refused:
            if refused.code == "unknown_upload" and attempt < 3:
                continue  # it expired, or another run with the same key deleted it
            await delete_uploads(exchange, form)
            raise
        await delete_uploads(exchange, form)
        return job
    raise AssertionError("unreachable: the last attempt returns or raises")


async def inspect(
    exchange: Exchange,
    inputs: Inputs,
    *,
    folder: Path,
    options: Options | Mapping[str, Any] | None,
    on_upload: OnBytes | None,
) -> Interpretation:
    """Have inputs read and checked without creating a job."""
    form = await in_thread(partial(inputs.form, folder, _fields(options), on_upload))
    call = Call(method="POST", path="/v1/inspect", form=form, changes_nothing=True)
    return await exchange.record(call, Interpretation)


async def get(exchange: Exchange, job: str) -> Job:
    """Read a job's record."""
    return await exchange.record(Call(method="GET", path=job_path(job)), Job)


async def jobs(exchange: Exchange, *, statuses: Iterable[Status | str], page_size: int) -> AsyncGenerator[Job, None]:
    """Yield every job, newest first, page by page."""
    wanted = [Status(status).value for status in statuses]
    cursor: str | None = None
    while True:
        params: dict[str, str | list[str]] = {"limit": str(page_size), "status": wanted}
        if cursor is not None:
            params["cursor"] = cursor
        page = await exchange.record(Call(method="GET", path="/v1/jobs", params=params), JobPage)
        for job in page.jobs:
            yield job
        cursor = page.next
        if cursor is None:
            return


def events(exchange: Exchange, job: str) -> AsyncGenerator[Job, None]:
    """Yield the job each time its record changes, until its status is final."""
    return follow(exchange, job_path(job))


async def wait(exchange: Exchange, job: str, *, on_progress: OnJob | None) -> Job:
    """Return the job once its status is final.

    With `on_progress` the client follows the event stream. Without it, it sends `Prefer: wait`, and polls a service that
    does not support this header.
    """
    path = job_path(job)
    if on_progress is not None:
        async with aclosing(follow(exchange, path)) as changes:
            async for now in changes:
                on_progress(now)
        return now
    retries = exchange.attempts.retries
    pause = retries.poll_interval / 4
    while True:
        seconds = max(1, int(min(retries.long_poll, exchange.attempts.remaining())))
        call = Call(method="GET", path=path, headers={"Prefer": f"wait={seconds}"})
        response, body = await exchange.answer(call)
        now = parse(Job, body, response.status_code)
        if now.status.final:
            return now
        if "wait" not in response.headers.get("preference-applied", ""):
            exchange.attempts.remaining()
            await async_sleep(pause)
            pause = min(retries.poll_interval, 1.5 * pause)


async def cancel(exchange: Exchange, job: str) -> Job:
    """Request that a job stops. Cancelling is idempotent, so the call may be repeated."""
    call = Call(method="POST", path=f"{job_path(job)}/cancel", headers={"Idempotency-Key": f"cancel-{job}"})
    return await exchange.record(call, Job)


async def retry(exchange: Exchange, job: str) -> Job:
    """Queue a new job with the inputs and options of a failed or cancelled one."""
    headers = {"Idempotency-Key": secrets.token_urlsafe(16)}
    return await exchange.record(Call(method="POST", path=f"{job_path(job)}/retry", headers=headers), Job)


async def make_outputs(exchange: Exchange, job: str, request: OutputRequest, *, key: str | None) -> Job:
    """Queue a job that writes further files of a result."""
    headers = {"Content-Type": JSON} | ({} if key is None else {"Idempotency-Key": key})
    body = request.model_dump_json(exclude_unset=True).encode()
    call = Call(method="POST", path=f"{job_path(job)}/outputs", headers=headers, content=body, changes_nothing=True)
    return await exchange.record(call, Job)


async def share(exchange: Exchange, job: str, request: ShareRequest) -> Share:
    """Create a share link."""
    body = request.model_dump_json(exclude_unset=True).encode()
    call = Call(method="POST", path=f"{job_path(job)}/shares", headers={"Content-Type": JSON}, content=body)
    return await exchange.record(call, Share)


async def shares(exchange: Exchange, job: str) -> Sequence[Share]:
    """Read the valid share links of a job."""
    _, body = await exchange.answer(Call(method="GET", path=f"{job_path(job)}/shares", headers={"Accept": JSON}))
    return [Share.model_validate(each) for each in json.loads(body)]


async def revoke_share(exchange: Exchange, job: str, share_id: str) -> None:
    """End a share link."""
    await exchange.answer(Call(method="DELETE", path=f"{job_path(job)}/shares/{quote(share_id, safe='')}"))


async def delete(exchange: Exchange, job: str) -> None:
    """Delete a job and its files."""
    try:
        await exchange.answer(Call(method="DELETE", path=job_path(job)))
    except NotFound:
        if exchange.attempts.failures == 0:  # otherwise an earlier attempt deleted it and its answer was lost
            raise


async def log(exchange: Exchange, job: str) -> str:
    """Read a job's log."""
    _, body = await exchange.answer(Call(method="GET", path=f"{job_path(job)}/log"))
    return body.decode("utf-8", "replace")


async def limits(exchange: Exchange) -> ServiceLimits:
    """Read the service's limits."""
    return await exchange.record(Call(method="GET", path="/v1/limits"), ServiceLimits)


async def document(exchange: Exchange, path: str) -> dict[str, Any]:
    """Read a JSON document that describes the service."""
    _, body = await exchange.answer(Call(method="GET", path=path, headers={"Accept": JSON}))
    value: dict[str, Any] = json.loads(body)
    return value


async def fetch(
    exchange: Exchange, job: Job, folder: Path, *, names: Iterable[str] | None, on_download: OnBytes | None
) -> dict[str, Path]:
    """Download files of a job, by default all, and return the path of each.

    Raises
    ------
    NotFound
        The job has no such file; the message lists those it has.
    """
    held = {artifact.name: artifact for artifact in job.artifacts}
    paths = {}
    for name in held if names is None else names:
        if name not in held:
            raise unknown_file(job, name)
        url = f"{job_path(job.id)}/artifacts/{quote(name)}"
        paths[name] = await download(exchange, url, held[name], folder, on_download=on_download)
    return paths


def _fields(options: Options | Mapping[str, Any] | None) -> dict[str, str]:
    return {"options": checked_options(options).model_dump_json(exclude_unset=True)}

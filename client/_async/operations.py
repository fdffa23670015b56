"""The operations that take several requests: submit, wait, fetch."""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Iterable, Mapping
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
from pliant.client.errors import BadArgument, InvalidRequest
from pliant.client.multipart import Inputs, OnBytes, option_fields
from pliant.client.pauses import async_sleep, in_thread
from pliant.client.requests import key_header
from pliant.client.result import job_path, unknown_file
from pliant.schemas.job import Job
from pliant.schemas.options import Options

WAITED = re.compile(r"wait=0*[1-9]")
"""`Preference-Applied` of a service that grants a wait."""

OnJob = Callable[[Job], None]
"""Called with the job each time its record changes."""


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
    if not isinstance(name, str):
        raise BadArgument(f"name: expected a str, got a value of type {type(name).__name__}.")
    texts = {
        "name": name.encode("utf-8", "replace").decode(), "priority": priority, "webhook": webhook or "",
        "webhook_secret": webhook_secret or "",
    }  # fmt: skip
    fields = option_fields(options) | {key: text for key, text in texts.items() if text != ""}
    whole = await in_thread(partial(inputs.form, folder, fields, exchange.attempts.bounding(on_upload)))
    key = idempotency_key if idempotency_key is not None else secrets.token_urlsafe(16)
    headers = key_header(key) if job_id is None or idempotency_key is not None else {}
    for attempt in (1, 2, 3):
        form = await upload_large(exchange, whole, key if job_id is None else f"id:{job_id}")
        call = Call(
            method="POST" if job_id is None else "PUT",
            path="/v1/jobs" if job_id is None else job_path(job_id),
            headers=headers,
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


async def wait(exchange: Exchange, job: str, *, on_progress: OnJob | None) -> Job:
    """Return the job once its status is final.

    With `on_progress` the client follows the event stream. Without it, it sends `Prefer: wait`, and polls a service that grants none.
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
        call = Call(method="GET", path=path, headers={"Prefer": f"wait={seconds}"}, delay=seconds)
        response, body = await exchange.answer(call)
        now = parse(Job, body, response.status_code)
        if now.status.final:
            return now
        if not WAITED.search(response.headers.get("preference-applied", "")):
            exchange.attempts.remaining()
            await async_sleep(pause)
            pause = min(retries.poll_interval, 1.5 * pause)


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
    for name in held if names is None else [names] if isinstance(names, str) else names:
        if name not in held:
            raise unknown_file(job, name)
        url = f"{job_path(job.id)}/artifacts/{quote(name)}"
        paths[name] = await download(exchange, url, held[name], folder, on_download=on_download)
    return paths

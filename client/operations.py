"""What can be asked of a service, each verb as a flow. Both clients run these and nothing else."""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pliant.client.download import download
from pliant.client.errors import BadArgument, InvalidRequest, JobCancelled, JobFailed, NotAllowedNow, NotFound
from pliant.client.events import events as follow
from pliant.client.events import told
from pliant.client.flow import Call, Do, Emit, Flow, Pause
from pliant.client.multipart import Inputs, OnBytes, checked_options
from pliant.client.retry import Attempts
from pliant.client.transport import answered, parse, record
from pliant.client.upload import removed, sent_ahead
from pliant.schemas.job import Interpretation, Job, JobPage, Problem, ServiceLimits, Status
from pliant.schemas.options import Options

OnJob = Callable[[Job], None]
"""Told the job each time something about it is new."""

JSON = "application/json"


def submit(
    attempts: Attempts,
    inputs: Inputs,
    *,
    folder: Path,
    options: Options | Mapping[str, Any] | None,
    name: str,
    job_id: str | None,
    idempotency_key: str | None,
    webhook: str | None,
    webhook_secret: str | None,
    on_upload: OnBytes | None,
) -> Flow[Job]:
    """Send inputs; the answer is the new job. Temporary files go into `folder`, which the caller removes."""
    texts = {"name": name, "webhook": webhook or "", "webhook_secret": webhook_secret or ""}
    fields = _fields(options) | {key: text for key, text in texts.items() if text != ""}
    whole = yield Do(lambda: inputs.form(folder, fields, on_upload))
    key = idempotency_key if idempotency_key is not None else secrets.token_urlsafe(16)
    for chance in (1, 2, 3):
        form = yield from sent_ahead(attempts, whole, key if job_id is None else f"id:{job_id}")
        call = Call(
            method="POST" if job_id is None else "PUT",
            path="/v1/jobs" if job_id is None else _path(job_id),
            headers={"Idempotency-Key": key} if job_id is None else {},
            form=form,
        )
        try:
            job = yield from record(attempts, call, Job)
        except InvalidRequest as refused:
            if refused.code == "unknown_upload" and chance < 3:
                continue  # it has expired, or another run with the same key has removed it
            yield from removed(attempts, form)
            raise
        yield from removed(attempts, form)
        return job
    raise AssertionError("unreachable: the last chance returns or raises")


def inspect(
    attempts: Attempts,
    inputs: Inputs,
    *,
    folder: Path,
    options: Options | Mapping[str, Any] | None,
    on_upload: OnBytes | None,
) -> Flow[Interpretation]:
    """Send inputs to be read and checked; the answer is how they were understood, and no job is made."""
    fields = _fields(options)
    form = yield Do(lambda: inputs.form(folder, fields, on_upload))
    call = Call(method="POST", path="/v1/inspect", form=form, changes_nothing=True)
    return (yield from record(attempts, call, Interpretation))


def get(attempts: Attempts, job: str) -> Flow[Job]:
    """Read a job's record."""
    return (yield from record(attempts, Call(method="GET", path=_path(job)), Job))


def jobs(attempts: Attempts, *, statuses: Iterable[Status | str], page_size: int) -> Flow[None]:
    """Emit every job, newest first, page by page."""
    wanted = [Status(status).value for status in statuses]
    cursor: str | None = None
    while True:
        params: dict[str, str | list[str]] = {"limit": str(page_size), "status": wanted}
        if cursor is not None:
            params["cursor"] = cursor
        page = yield from record(attempts, Call(method="GET", path="/v1/jobs", params=params), JobPage)
        for job in page.jobs:
            yield Emit(job)
        cursor = page.next
        if cursor is None:
            return


def events(attempts: Attempts, job: str) -> Flow[Job]:
    """Emit the job each time something about it is new, until it is over."""
    return (yield from follow(attempts, _path(job)))


def wait(attempts: Attempts, job: str, *, on_progress: OnJob | None) -> Flow[Job]:
    """Return the job once its status is final.

    While somebody watches, events tell what is new. Otherwise the service is asked to hold its answer back (`Prefer: wait`),
    and where it does not do so, the job is looked at again and again.
    """
    if on_progress is not None:
        return (yield from told(follow(attempts, _path(job)), on_progress))
    pause = attempts.policy.poll_interval / 4
    while True:
        seconds = max(1, int(min(attempts.policy.long_poll, attempts.remaining())))
        call = Call(method="GET", path=_path(job), headers={"Prefer": f"wait={seconds}"})
        head, body = yield from answered(attempts, call)
        now = parse(Job, body, head)
        if now.status.final:
            return now
        if "wait" not in head.headers.get("preference-applied", ""):
            attempts.remaining()
            yield Pause(pause)
            pause = min(attempts.policy.poll_interval, 1.5 * pause)


def cancel(attempts: Attempts, job: str) -> Flow[Job]:
    """Ask for a job to be stopped. Cancelling twice is cancelling once, so the call may be repeated."""
    call = Call(method="POST", path=f"{_path(job)}/cancel", headers={"Idempotency-Key": f"cancel-{job}"})
    return (yield from record(attempts, call, Job))


def retry(attempts: Attempts, job: str) -> Flow[Job]:
    """Queue a new job with the inputs and options of one that failed or was cancelled."""
    headers = {"Idempotency-Key": secrets.token_urlsafe(16)}
    return (yield from record(attempts, Call(method="POST", path=f"{_path(job)}/retry", headers=headers), Job))


def delete(attempts: Attempts, job: str) -> Flow[None]:
    """Remove a job and its files."""
    try:
        yield from answered(attempts, Call(method="DELETE", path=_path(job)))
    except NotFound:
        if attempts.failures == 0:  # else an earlier try did it, and only its answer was lost
            raise


def log(attempts: Attempts, job: str) -> Flow[str]:
    """Read what a job's attempts have logged."""
    _, body = yield from answered(attempts, Call(method="GET", path=f"{_path(job)}/log"))
    return body.decode("utf-8", "replace")


def limits(attempts: Attempts) -> Flow[ServiceLimits]:
    """Read what the service accepts at most."""
    return (yield from record(attempts, Call(method="GET", path="/v1/limits"), ServiceLimits))


def document(attempts: Attempts, path: str) -> Flow[dict[str, Any]]:
    """Read a JSON document that describes the service itself."""
    _, body = yield from answered(attempts, Call(method="GET", path=path, headers={"Accept": JSON}))
    value: dict[str, Any] = json.loads(body)
    return value


def succeeded(job: Job) -> Job:
    """Return the job if it has a result.

    Raises
    ------
    JobFailed, JobCancelled
        It has none.
    """
    if job.status == Status.FAILED:
        raise JobFailed(job)
    if job.status == Status.CANCELLED:
        raise JobCancelled(job)
    return job


def finished(job: Job) -> Job:
    """Return the job if it is over and has a result.

    Raises
    ------
    NotAllowedNow, JobFailed, JobCancelled
        It is not over, or there is no result.
    """
    if not job.status.final:
        raise NotAllowedNow(
            Problem(
                title="The job is not over",
                status=409,
                code="not_finished",
                detail=f"Job {job.id} is {job.status}; there is no result yet. Wait for it.",
                retryable=True,
            )
        )
    return succeeded(job)


def fetch(
    attempts: Attempts, job: Job, folder: Path, *, names: Iterable[str] | None, on_download: OnBytes | None
) -> Flow[dict[str, Path]]:
    """Fetch files of a job, all unless named, and return where each is.

    Raises
    ------
    NotFound
        The job has no such file; the sentence lists those it has.
    """
    held = {artifact.name: artifact for artifact in job.artifacts}
    wanted = list(held) if names is None else list(names)
    paths = {}
    for name in wanted:
        if name not in held:
            raise NotFound(
                Problem(
                    title="No such file",
                    status=404,
                    code="unknown_artifact",
                    detail=f"Job {job.id} ({job.status}) has no file {name!r}. It has: {', '.join(held) or 'none'}.",
                )
            )
        url = f"{_path(job.id)}/artifacts/{quote(name)}"
        paths[name] = yield from download(attempts, url, held[name], folder, on_download=on_download)
    return paths


def _fields(options: Options | Mapping[str, Any] | None) -> dict[str, str]:
    return {"options": checked_options(options).model_dump_json(exclude_unset=True)}


def _path(job: str) -> str:
    if re.fullmatch(r"[A-Za-z0-9_-]{1,128}", job) is None:
        raise BadArgument(f"Expected the id of a job (letters, digits, - and _), got {job!r}.")
    return f"/v1/jobs/{job}"

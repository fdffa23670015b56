"""Commands that talk to a service."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from pliant.cli.session import (
    HOME,
    GroundTruth,
    JobId,
    Json,
    Mesh,
    OptionPairs,
    Rotations,
    Session,
    Timeout,
    Tracks,
    Url,
    parse_options,
)  # fmt: skip
from pliant.cli.show import err, out, print_json, show_job, show_jobs, show_options

Folder = Annotated[Path | None, typer.Option("--output", "-o", help="Wait, and fetch the files into this folder.")]


def submit(
    ctx: typer.Context,
    tracks: Tracks,
    mesh: Mesh = None,
    ground_truth: GroundTruth = None,
    rotations: Rotations = None,
    option: OptionPairs = None,
    name: Annotated[str, typer.Option("--name", "-n", help="Your own label.")] = "",
    job_id: Annotated[
        str | None, typer.Option("--id", help="Your own id: the same id and content is the same job.")
    ] = None,
    key: Annotated[str | None, typer.Option("--key", help="Idempotency key: repeating it makes no second job.")] = None,
    webhook: Annotated[
        str | None,
        typer.Option(
            "--webhook", help="Address that gets the finished job; signed with PLIANT_WEBHOOK_SECRET.", metavar="URL"
        ),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", "-w", help="Wait until the job is over.")] = False,
    output: Folder = None,
    url: Url = HOME,
    timeout: Timeout = None,
    as_json: Json = False,
) -> None:
    """Send tracks to a service; prints the job."""
    from pliant.client.progress import progress_bar

    session: Session = ctx.obj
    options = parse_options(option)
    with session.client(url, as_json=as_json) as client:
        with progress_bar() as bar:
            job = client.submit(
                tracks,
                mesh=mesh,
                ground_truth=ground_truth,
                rotations=rotations,
                options=options,
                name=name,
                job_id=job_id,
                idempotency_key=key,
                webhook=webhook,
                webhook_secret=None if webhook is None else os.environ.get("PLIANT_WEBHOOK_SECRET"),
                on_upload=bar.on_upload,
                timeout=timeout,
            )
            if wait or output is not None:
                done = job.wait(on_progress=bar.on_progress, load=False, timeout=timeout)
                job.record = done.job
                if output is not None:
                    done.download(output, on_download=bar.on_download)
        show_job(job.record, as_json=as_json)
        if not job.status.final and not as_json:
            err().print(f"Follow it with: pliant watch {job.id}")


def status(ctx: typer.Context, job: JobId, url: Url = HOME, as_json: Json = False) -> None:
    """Show a job as it stands now."""
    with ctx.obj.client(url, as_json=as_json) as client:
        show_job(client.get(job).record, as_json=as_json)


def watch(ctx: typer.Context, job: JobId, url: Url = HOME, timeout: Timeout = None, as_json: Json = False) -> None:
    """Follow a job until it is over; exit code 1 if it failed or was cancelled."""
    from pliant.client.progress import progress_bar

    with ctx.obj.client(url, as_json=as_json) as client:
        with progress_bar() as bar:
            done = client.wait(job, on_progress=bar.on_progress, load=False, timeout=timeout)
        show_job(done.job, as_json=as_json)


def result(
    ctx: typer.Context,
    job: JobId,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the files.")] = Path(),
    only: Annotated[list[str] | None, typer.Option("--only", help="Fetch this file alone; again for more.")] = None,
    url: Url = HOME,
    timeout: Timeout = None,
    as_json: Json = False,
) -> None:
    """Fetch the files of a finished job; an interrupted fetch is continued."""
    from pliant.client.progress import progress_bar

    with ctx.obj.client(url, as_json=as_json) as client:
        done = client.result(job, load=False, timeout=timeout)
        with progress_bar() as bar:
            paths = done.download(output, names=only, on_download=bar.on_download, timeout=timeout)
    if as_json:
        print_json({name: str(path) for name, path in paths.items()})
        return
    for path in paths.values():
        out().print(str(path), markup=False)


def list_jobs(
    ctx: typer.Context,
    status: Annotated[
        list[str] | None, typer.Option("--status", "-s", help="Only jobs of this status; again for more.")
    ] = None,
    limit: Annotated[int, typer.Option("--limit", "-l", help="At most this many.", min=1)] = 20,
    url: Url = HOME,
    as_json: Json = False,
) -> None:
    """List jobs, newest first."""
    from itertools import islice

    from pliant.client.errors import BadArgument
    from pliant.schemas.job import Status

    unknown = sorted(set(status or ()) - set(Status))
    if len(unknown) > 0:
        raise BadArgument(f"--status: expected one of {', '.join(Status)}, got {unknown[0]!r}.")
    with ctx.obj.client(url, as_json=as_json) as client:
        jobs = client.list(statuses=status or (), page_size=min(limit, 100))
        show_jobs([job.record for job in islice(jobs, limit)], as_json=as_json)


def log(ctx: typer.Context, job: JobId, url: Url = HOME, as_json: Json = False) -> None:
    """Show what a job's attempts have logged."""
    with ctx.obj.client(url, as_json=as_json) as client:
        lines = client.log(job).splitlines()
    if as_json:
        print_json(lines)
        return
    for line in lines:
        out().print(line, markup=False)


def cancel(ctx: typer.Context, job: JobId, url: Url = HOME, as_json: Json = False) -> None:
    """Stop a job."""
    with ctx.obj.client(url, as_json=as_json) as client:
        show_job(client.cancel(job).record, as_json=as_json)


def retry(ctx: typer.Context, job: JobId, url: Url = HOME, as_json: Json = False) -> None:
    """Queue a new job with what a failed or cancelled one had; prints the new job."""
    with ctx.obj.client(url, as_json=as_json) as client:
        show_job(client.retry(job).record, as_json=as_json)


def delete(
    ctx: typer.Context,
    jobs: Annotated[list[str], typer.Argument(help="Ids of jobs that are over.", show_default=False)],
    url: Url = HOME,
    as_json: Json = False,
) -> None:
    """Remove jobs and their files from the service."""
    with ctx.obj.client(url, as_json=as_json) as client:
        for job in jobs:
            client.delete(job)
    if as_json:
        print_json({"deleted": jobs})


def options(ctx: typer.Context, url: Url = "", as_json: Json = False) -> None:
    """List every option: meaning, bounds, default. Asks the service if --url is given, else this installation."""
    if url == "":
        from pliant.schemas.options import Options

        schema = Options.model_json_schema()
    else:
        with ctx.obj.client(url, as_json=as_json) as client:
            schema = client.options()
    show_options(schema, as_json=as_json)

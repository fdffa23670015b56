"""Commands that use a service."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from pliant.cli.films import is_film
from pliant.cli.ids import find_job
from pliant.cli.paths import check_inputs, different_files, output_folder, results_folder
from pliant.cli.session import (
    HOME,
    LINE_EVERY,
    Force,
    GroundTruth,
    JobId,
    Json,
    Mesh,
    Name,
    OptionPairs,
    Region,
    Rotations,
    Session,
    Timeout,
    Url,
    name_of,
    parse_options,
)  # fmt: skip
from pliant.cli.show import err, out, print_json, show_job, show_jobs, show_options

if TYPE_CHECKING:
    from pliant.client import Client, RemoteJob

Files = Annotated[
    list[Path],
    typer.Argument(
        help="Track files in any format `pliant inspect` reads, a film, or a folder with its pictures. Several of them, a folder of track "
        "files or a quoted pattern such as 'takes/*.npz' make a job each.",
        metavar="FILE...",
        show_default=False,
    ),
]
Priority = Annotated[
    Literal["high", "normal", "low"], typer.Option("--priority", help="Order among your own waiting jobs.")
]
OwnId = Annotated[
    str | None, typer.Option("--id", help="Your own id. Submitting the same content under it again creates no second job.")
]  # fmt: skip
Key = Annotated[str | None, typer.Option("--key", help="Idempotency key: a repeated submission creates no second job.")]
Webhook = Annotated[
    str | None,
    typer.Option(
        "--webhook", help="URL that receives the finished job, signed with PLIANT_WEBHOOK_SECRET.", metavar="URL"
    ),
]
Wait = Annotated[bool, typer.Option("--wait", "-w", help="Wait until the job is finished.")]
Folder = Annotated[Path | None, typer.Option("--output", "-o", help="Wait, then download the files into this folder.")]


def submit(
    ctx: typer.Context, files: Files, mesh: Mesh = None, ground_truth: GroundTruth = None, rotations: Rotations = None,
    region: Region = None, option: OptionPairs = None, name: Name = "", priority: Priority = "normal", job_id: OwnId = None,
    key: Key = None, webhook: Webhook = None, wait: Wait = False, output: Folder = None, force: Force = False, url: Url = HOME,
    timeout: Timeout = None, as_json: Json = False,
) -> None:  # fmt: skip
    """Submit tracks or a film to a service and print the job, or a table of jobs for several files.

    With several files, repeating the command finds the existing jobs by the contents of the files and the options.
    """
    from pliant.cli.commands.batch import Batch, expand

    session: Session = ctx.obj
    options, chosen, waits = parse_options(option), expand(files, region), wait or output is not None
    parts = {"mesh": mesh, "ground_truth": ground_truth, "rotations": rotations, "webhook": webhook}
    if chosen != files or len(chosen) > 1:
        check_inputs(None, mesh=mesh, ground_truth=ground_truth, rotations=rotations, region=None)
        batch = Batch(
            files=chosen, shared=parts, options=options, key=key or "", priority=priority, timeout=timeout, output=output, force=force,
            wait=waits, url=url, session=session,
        )  # fmt: skip
        batch.check(name=name, job_id=job_id, region=region)
        with session.client(url) as client:
            batch.run(client)
        batch.show(as_json=as_json)
        raise typer.Exit(batch.exit_code)
    tracks = chosen[0]
    check_inputs(tracks, mesh=mesh, ground_truth=ground_truth, rotations=rotations, region=region)
    given = {
        "region": region, **parts, "options": options,
        "name": name_of(name, tracks), "job_id": job_id, "idempotency_key": key, "priority": priority, "timeout": timeout,
        "webhook_secret": None if webhook is None else os.environ.get("PLIANT_WEBHOOK_SECRET"),
    }  # fmt: skip
    given["film" if is_film(tracks, region) else "tracks"] = tracks
    known = job_id is not None or key is not None  # a named job may be an earlier one, whose files may be here already
    place = nullcontext() if output is None else results_folder(output, force=force or known)
    with place, session.client(url) as client:
        job = _submit(session, client, given, wait=waits, output=output, force=force, as_json=as_json)
        show_job(job.record, as_json=as_json)
        if not job.status.final and not as_json:
            err().print(f"Follow it with: pliant watch {job.id}")


def _submit(
    session: Session,
    client: Client,
    given: dict[str, Any],
    *,
    wait: bool,
    output: Path | None,
    force: bool,
    as_json: bool,
) -> RemoteJob:
    """Submit one job with a progress bar; if requested, wait for it and download its files."""
    from pliant.client.progress import progress_bar

    with progress_bar(line_every=LINE_EVERY) as bar:
        job = client.submit(**given, on_upload=bar.on_upload)
        if wait:
            session.following = job.id
            if not as_json:
                err().print(f"Job {job.id}")
            done = job.wait(on_progress=bar.on_progress, load=False, timeout=given["timeout"])
            if output is not None:
                output_folder(output, force=force, files=different_files(done.job, output))
                done.download(output, on_download=bar.on_download, timeout=given["timeout"])
    return job


def status(ctx: typer.Context, job: JobId, url: Url = HOME, as_json: Json = False) -> None:
    """Print a job's current record."""
    with ctx.obj.client(url) as client:
        show_job(find_job(client, job).record, as_json=as_json)


def watch(ctx: typer.Context, job: JobId, url: Url = HOME, timeout: Timeout = None, as_json: Json = False) -> None:
    """Follow a job until it is finished; exit code 1 if it failed or was cancelled."""
    from pliant.client.progress import progress_bar

    with ctx.obj.client(url) as client:
        ctx.obj.following = found = find_job(client, job).id
        with progress_bar(line_every=LINE_EVERY) as bar:
            done = client.wait(found, on_progress=bar.on_progress, load=False, timeout=timeout)
        show_job(done.job, as_json=as_json)


def result(
    ctx: typer.Context,
    job: JobId,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the files.")] = Path(),
    force: Force = False,
    only: Annotated[list[str] | None, typer.Option("--only", help="Download only this file; may be repeated.")] = None,
    make: Annotated[
        list[str] | None,
        typer.Option(
            "--make",
            help="First write this from the stored result: glb, ply, obj, usd, abc, mdd, mat or csv; several as "
            "usd,mdd, or by repeating. Only these files are downloaded then.",
        ),
    ] = None,
    fps: Annotated[float | None, typer.Option("--fps", help="With --make: frames per second of the animation.")] = None,
    url: Url = HOME,
    timeout: Timeout = None,
    as_json: Json = False,
) -> None:
    """Download the files of a finished job. Interrupted downloads resume."""
    from pliant.client.errors import BadArgument
    from pliant.client.progress import progress_bar

    if fps is not None and not make:
        raise BadArgument("--fps: expected --make beside it. The stored files keep the frame rate of their job.")
    with ctx.obj.client(url) as client:
        found = find_job(client, job).id
        if make:
            further = client.make_outputs(found, ",".join(make), fps=fps, timeout=timeout)
            ctx.obj.following = found = further.id
            with progress_bar(line_every=LINE_EVERY) as bar:
                done = further.wait(on_progress=bar.on_progress, load=False, timeout=timeout)
            only = only or [each.name for each in done.job.artifacts if each.name != "report.json"]
        else:
            done = client.result(found, load=False, timeout=timeout)
        changed = different_files(done.job, output, only)
        with results_folder(output, force=force, files=changed), progress_bar(line_every=LINE_EVERY) as bar:
            paths = done.download(output, names=only, on_download=bar.on_download, timeout=timeout)
    if as_json:
        print_json({name: str(path) for name, path in paths.items()})
        return
    for path in paths.values():
        out().print(str(path))


def list_jobs(
    ctx: typer.Context,
    status: Annotated[
        list[str] | None, typer.Option("--status", "-s", help="Only jobs with this status; may be repeated.")
    ] = None,
    limit: Annotated[int, typer.Option("--limit", "-l", help="At most this many.", min=1)] = 20,
    url: Url = HOME,
    as_json: Json = False,
) -> None:
    """List jobs, newest first."""
    from pliant.client.errors import BadArgument
    from pliant.schemas.job import Status

    unknown = sorted(set(status or ()) - set(Status))
    if len(unknown) > 0:
        raise BadArgument(f"--status: expected one of {', '.join(Status)}, got {unknown[0]!r}.")
    with ctx.obj.client(url) as client:
        jobs = client.list(statuses=status or (), limit=limit, page_size=100)
        show_jobs([job.record for job in jobs], as_json=as_json)


def log(ctx: typer.Context, job: JobId, url: Url = HOME, as_json: Json = False) -> None:
    """Print a job's log."""
    with ctx.obj.client(url) as client:
        lines = find_job(client, job).log().splitlines()
    if as_json:
        print_json(lines)
        return
    for line in lines:
        out().print(line)


def cancel(ctx: typer.Context, job: JobId, url: Url = HOME, as_json: Json = False) -> None:
    """Stop a job."""
    with ctx.obj.client(url) as client:
        show_job(find_job(client, job).cancel().record, as_json=as_json)


def retry(ctx: typer.Context, job: JobId, url: Url = HOME, as_json: Json = False) -> None:
    """Run a failed or cancelled job again, and print the new job."""
    with ctx.obj.client(url) as client:
        show_job(find_job(client, job).retry().record, as_json=as_json)


def delete(
    ctx: typer.Context,
    jobs: Annotated[list[str], typer.Argument(help="Finished jobs, each as for `pliant status`.", show_default=False)],
    url: Url = HOME,
    as_json: Json = False,
) -> None:
    """Delete jobs and their files from the service."""
    with ctx.obj.client(url) as client:
        found = {job.id: job for job in [find_job(client, job) for job in jobs]}  # find all before deleting the first
        for job in found.values():
            job.delete()
    ids = list(found)
    if as_json:
        print_json({"deleted": ids})
    else:
        err().print(f"Deleted: {', '.join(ids)}")


def options(ctx: typer.Context, url: Url = "", as_json: Json = False) -> None:
    """List every option with its meaning, bounds and default, for the service at --url or else this installation."""
    if url == "":
        from pliant.schemas.options import Options

        schema = Options.model_json_schema()
    else:
        with ctx.obj.client(url) as client:
            schema = client.options()
    show_options(schema, as_json=as_json)

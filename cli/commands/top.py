"""`pliant top`: queue, workers and jobs of a service, redrawn every few seconds."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import typer
from pliant.cli.session import HOME, Json, Url
from pliant.cli.show import COLOURS, out, print_json

if TYPE_CHECKING:
    from pliant.client import Client
    from pliant.schemas.job import Job
    from rich.table import Table

SHOWN = 20
"""Maximum number of jobs in the table."""


@dataclass(frozen=True, slots=True)
class View:
    """A snapshot of the service."""

    parts: dict[str, str]
    """`ok` or the reason for a failure, for each of the job store, the blob store and the workers."""
    running: int
    queued: int
    jobs: tuple[Job, ...]
    """The unfinished jobs, then the newest finished ones."""


def top(
    ctx: typer.Context,
    every: Annotated[float, typer.Option("--every", help="Seconds between updates.", min=0.5)] = 2.0,
    once: Annotated[bool, typer.Option("--once", help="Print once and end.")] = False,
    url: Url = HOME,
    as_json: Json = False,
) -> None:
    """Show running, queued and recent jobs, and the state of every component of the service. Ctrl-C stops it."""
    with ctx.obj.client(url) as client:
        if as_json:
            view = read_view(client)
            print_json({**asdict(view), "jobs": [job.model_dump(mode="json") for job in view.jobs]})
            return
        if once:
            out().print(draw(read_view(client)))
            return
        from rich.live import Live

        with Live(draw(read_view(client)), console=out(), screen=True, auto_refresh=False) as live:
            while True:
                time.sleep(every)
                live.update(draw(read_view(client)), refresh=True)


def read_view(client: Client) -> View:
    """Query the service."""
    from itertools import islice

    from pliant.client.errors import ServiceFailed

    try:
        parts = {name: str(state) for name, state in client.ready(timeout=15).items()}
    except ServiceFailed as error:
        parts = {"service": str(error)}
    running = [job.record for job in client.list(statuses=["running", "cancelling"])]
    queued = [job.record for job in client.list(statuses=["queued"])]
    queued.sort(key=lambda job: (job.place_in_queue is None, job.place_in_queue or 0))
    shown = [*running, *queued][:SHOWN]
    ended = client.list(statuses=["succeeded", "failed", "cancelled"], page_size=SHOWN)
    shown += [job.record for job in islice(ended, SHOWN - len(shown))]
    return View(parts, len(running), len(queued), tuple(shown))


def draw(view: View) -> Table:
    """Return the snapshot as a table."""
    from rich.table import Table
    from rich.text import Text

    states = "   ".join(f"{name} {state}" for name, state in view.parts.items())
    table = Table(title=f"{view.running} running, {view.queued} queued   {states}", title_justify="left", expand=True)
    for column in ("job", "name", "status", "progress", "stage", "left", "attempt"):
        table.add_column(column)
    for job in view.jobs:
        progress = None if job.status.final else job.progress
        left = None if progress is None else progress.seconds_left
        table.add_row(
            job.id, Text(job.name), Text(str(job.status), COLOURS[job.status]),
            "" if progress is None else f"{progress.fraction:.0%}", "" if progress is None else progress.stage,
            "" if left is None else f"{left:.0f} s", str(job.attempt),
        )  # fmt: skip
    return table

"""The command line. Everything heavy is imported inside the commands, so that `pliant --help` is quick."""

from __future__ import annotations

from typing import Annotated

import typer
from pliant.client.cli import jobs
from pliant.client.cli.exits import Guarded
from pliant.client.cli.session import Session

app = typer.Typer(
    name="pliant",
    cls=Guarded,
    help="Dense 2-D point tracks of a deforming thing in, a moving 3-D mesh out.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"pliant {version('pliant')}")
        raise typer.Exit


@app.callback()
def _begin(
    ctx: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    del version
    if ctx.obj is None:
        ctx.obj = Session()


_SERVICE = "Talk to a service"
for command, name in (
    (jobs.submit, "submit"), (jobs.status, "status"), (jobs.watch, "watch"), (jobs.result, "result"), (jobs.list_jobs, "list"),
    (jobs.cancel, "cancel"), (jobs.retry, "retry"), (jobs.delete, "delete"), (jobs.options, "options"),
):  # fmt: skip
    app.command(name, rich_help_panel=_SERVICE)(command)


def main() -> None:
    """Run the command line."""
    app()

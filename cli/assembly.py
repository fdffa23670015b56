"""All commands. Heavy modules are imported inside the commands, so that `pliant --help` is fast."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer
from pliant.cli import jobs
from pliant.cli.commands import tokens
from pliant.cli.commands.backup import backup, restore
from pliant.cli.commands.explain import explain
from pliant.cli.commands.results import rerun, share, view
from pliant.cli.commands.top import top
from pliant.cli.demo import demo
from pliant.cli.doctor import doctor, fsck
from pliant.cli.exits import Guarded
from pliant.cli.session import Session
from pliant.cli.solve import inspect, solve
from pliant.cli.track import track
from pliant.cli.up import up, work

app = typer.Typer(
    name="pliant",
    cls=Guarded,
    help="Reconstruct a moving 3-D mesh from a film of a deforming surface, or from dense 2-D point tracks.",
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


_COMMANDS: dict[str, dict[str, Callable[..., None]]] = {
    "On this machine": {
        "solve": solve, "track": track, "inspect": inspect, "view": view, "demo": demo, "doctor": doctor,
        "explain": explain,
    },
    "Run a service": {"up": up, "work": work, "fsck": fsck, "backup": backup, "restore": restore, "top": top},
    "Use a service": {
        "submit": jobs.submit, "status": jobs.status, "watch": jobs.watch, "result": jobs.result, "list": jobs.list_jobs,
        "log": jobs.log, "cancel": jobs.cancel, "retry": jobs.retry, "rerun": rerun, "share": share, "delete": jobs.delete,
        "options": jobs.options,
    },
}  # fmt: skip
for panel, commands in _COMMANDS.items():
    for name, command in commands.items():
        app.command(name, rich_help_panel=panel)(command)
app.add_typer(tokens.app, rich_help_panel="Run a service")

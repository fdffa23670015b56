"""The `pliant` command. It may import any folder, inside its functions; nobody imports it."""

from __future__ import annotations

import typer

app = typer.Typer(no_args_is_help=True, help="Dense 2-D point tracks of a deforming thing in, a moving 3-D mesh out.")


@app.callback()
def pliant() -> None:
    """Dense 2-D point tracks of a deforming thing in, a moving 3-D mesh out."""


def main() -> None:
    """Run the command line."""
    app()

"""The command line: `app` has the commands, `main` runs them. This module imports little, so that Ctrl-C at the start is caught."""

from __future__ import annotations

if __name__ != "pliant.cli":
    raise ImportError(f"import this folder as pliant.cli, not as {__name__!r}: install it with pip install -e .")

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.cli.assembly import app

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line."""
    try:
        from pliant.cli.assembly import app

        app(prog_name="pliant")
    except KeyboardInterrupt:  # before the command began; `Guarded` catches later ones
        print("error Interrupted.", file=sys.stderr)
        sys.exit(130)


def __getattr__(name: str) -> object:
    if name != "app":
        raise AttributeError(f"module 'pliant.cli' has no attribute {name!r}")
    from pliant.cli.assembly import app

    return app

"""What the command line prints in a test."""

from __future__ import annotations

from collections.abc import Callable

from typer.testing import Result

Run = Callable[..., Result]
"""Runs a command with these arguments."""


def words(ran: Result) -> str:
    """Return standard error without line breaks."""
    return " ".join(ran.stderr.split())

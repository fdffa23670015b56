"""Commands of Pliant in tests: their environment, and what they print."""

from __future__ import annotations

import os
from collections.abc import Callable

from typer.testing import Result

CLEAN = {name: value for name, value in os.environ.items() if not name.startswith("PLIANT_")}
"""The environment without variables of Pliant."""

Run = Callable[..., Result]
"""Runs a command with these arguments."""


def words(ran: Result) -> str:
    """Return standard error without line breaks."""
    return " ".join(ran.stderr.split())

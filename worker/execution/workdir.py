"""The working files of an attempt, while it runs and when it is dead."""

from __future__ import annotations

import shutil
from pathlib import Path

from pliant.worker.settings import Settings

OUTPUT = "output.log"
"""What the attempt writes to its standard output and error, its crash's stack among it."""


def working_directory(settings: Settings, attempt_id: str) -> Path:
    """Return the directory of an attempt's working files."""
    return settings.work / attempt_id


def last_words(settings: Settings, attempt_id: str) -> list[str]:
    """Return the end of what a dead attempt wrote to its standard output and error."""
    file = working_directory(settings, attempt_id) / OUTPUT
    if not file.exists():
        return []
    with file.open("rb") as output:
        output.seek(max(0, file.stat().st_size - 16_384))
        return output.read().decode(errors="replace").splitlines()[-100:]


def clean_up(settings: Settings, attempt_id: str) -> None:
    """Remove an attempt's working files."""
    shutil.rmtree(working_directory(settings, attempt_id), ignore_errors=True)

"""Scratch directories of attempts."""

from __future__ import annotations

import shutil
from pathlib import Path

from pliant.worker.settings import Settings

OUTPUT = "output.log"
"""File with the attempt's standard output and error, including crash traces."""


def working_directory(settings: Settings, attempt_id: str) -> Path:
    """Return the scratch directory of an attempt."""
    return settings.work / attempt_id


def output_tail(settings: Settings, attempt_id: str) -> list[str]:
    """Return the end of an attempt's standard output and error: at most 100 lines and 16 KiB."""
    file = working_directory(settings, attempt_id) / OUTPUT
    if not file.exists():
        return []
    with file.open("rb") as output:
        output.seek(max(0, file.stat().st_size - 16_384))
        return output.read().decode(errors="replace").splitlines()[-100:]


def clean_up(settings: Settings, attempt_id: str) -> None:
    """Remove an attempt's scratch directory."""
    shutil.rmtree(working_directory(settings, attempt_id), ignore_errors=True)

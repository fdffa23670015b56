"""What container files, units and charts may name: commands that exist and variables that are read."""

from __future__ import annotations

import importlib.util

from pliant.cli import app
from pliant.service.settings import ServiceSettings
from pliant.worker.environment import fields_of, variable_of
from pliant.worker.settings import Settings
from typer.main import get_command


def starts(command: list[str]) -> bool:
    """Return True if the command is one of ours and takes the options given."""
    if command[:2] == ["python", "-m"]:
        return importlib.util.find_spec(f"{command[2]}.__main__") is not None
    assert command[0] == "pliant"
    known = get_command(app).commands[command[1]]  # type: ignore[attr-defined]
    options = {name for parameter in known.params for name in parameter.opts}
    return {word for word in command[2:] if word.startswith("--")} <= options


def read_variables() -> set[str]:
    """Return every variable that service or worker reads."""
    return {variable_of(name) for record in (Settings, ServiceSettings) for name in fields_of(record)}

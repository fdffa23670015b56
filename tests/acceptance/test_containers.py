"""The container files, as far as they can be checked without an engine: what they start exists, what they set is read."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from pliant.cli import app
from pliant.worker.settings import VARIABLES
from typer.main import get_command

ROOT = Path(__file__).parent.parent.parent
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
DOCKERFILE = (ROOT / "Dockerfile").read_text()


def starts(command: list[str]) -> bool:
    """Return True if the command is one of ours and takes the options given."""
    if command[:2] == ["python", "-m"]:
        return importlib.util.find_spec(f"{command[2]}.__main__") is not None
    assert command[0] == "pliant"
    known = get_command(app).commands[command[1]]  # type: ignore[attr-defined]
    options = {name for parameter in known.params for name in parameter.opts}
    return {word for word in command[2:] if word.startswith("--")} <= options


@pytest.mark.parametrize("name", ["api", "worker"])
def test_the_services_start_what_exists(name: str) -> None:
    assert starts(COMPOSE["services"][name]["command"])


def test_the_image_alone_starts_the_whole_service() -> None:
    (command,) = re.findall(r"^CMD (\[.*\])$", DOCKERFILE, flags=re.MULTILINE)
    assert starts(yaml.safe_load(command))


def test_every_variable_that_is_set_is_one_that_is_read() -> None:
    read = (
        {variable for variable, _, _ in VARIABLES.values()}
        | {"PLIANT_PAGE"}
        | set(re.findall(r"PLIANT_\w+", (ROOT / "service" / "settings.py").read_text()))
    )
    used = (
        set(COMPOSE["x-pliant"]["environment"])
        | set(COMPOSE["services"]["api"]["environment"])
        | set(re.findall(r"(PLIANT_\w+)=", DOCKERFILE))
    )
    assert used <= read


def test_whoever_needs_the_queue_waits_until_it_is_healthy() -> None:
    services = COMPOSE["services"]
    assert "healthcheck" in services["valkey"]
    assert "/readyz" in services["api"]["healthcheck"]["test"][-1]
    for name in ("api", "worker"):
        assert services[name]["depends_on"] == {"valkey": {"condition": "service_healthy"}}


def test_nothing_is_open_to_the_world_and_no_secret_has_a_default() -> None:
    text = (ROOT / "docker-compose.yml").read_text()
    assert COMPOSE["services"]["api"]["ports"] == ["127.0.0.1:8000:8000"]
    assert "ports" not in COMPOSE["services"]["valkey"]
    assert set(re.findall(r"\$\{PLIANT_REDIS_PASSWORD(.{2})", text)) == {":?"}

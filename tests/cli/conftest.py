"""The command line against the in-memory `service` of a test."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from pliant.cli import app
from pliant.cli.session import Session
from pliant.service.testing import InMemoryService
from typer.testing import CliRunner, Result


@pytest.fixture
def run(service: InMemoryService, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    for name in ("PLIANT_URL", "PLIANT_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    return lambda *arguments: CliRunner().invoke(app, [str(each) for each in arguments], obj=Session(transport=service))

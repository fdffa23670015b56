"""The command line against an in-memory service."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pliant.cli import app
from pliant.cli.session import Session
from pliant.service.testing import InMemoryService
from typer.testing import CliRunner, Result


@pytest.fixture
def service() -> InMemoryService:
    return InMemoryService(steps=1)


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    path = tmp_path / "tracks.npz"
    np.savez(path, tracks=np.random.default_rng(0).normal(size=(5, 12, 2)) * 100)
    return path


@pytest.fixture
def run(service: InMemoryService, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    for name in ("PLIANT_URL", "PLIANT_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    return lambda *arguments: CliRunner().invoke(app, [str(each) for each in arguments], obj=Session(transport=service))

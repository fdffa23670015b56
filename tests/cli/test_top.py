"""`pliant top` on the real application in memory."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from pliant.cli import app
from pliant.cli.commands.top import draw, read_view
from pliant.cli.session import Session
from pliant.client import Client
from pliant.service.testing import InMemoryService
from rich.console import Console
from typer.testing import CliRunner


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> InMemoryService:
    monkeypatch.delenv("PLIANT_URL", raising=False)
    monkeypatch.setenv("COLUMNS", "160")
    return InMemoryService(steps=1)


def test_running_and_queued_jobs_come_first(service: InMemoryService) -> None:
    tracks = np.random.default_rng(0).normal(size=(5, 12, 2))
    with Client("http://pliant.test", transport=service) as client:
        client.submit(tracks, mesh="none", name="done").wait(load=False, timeout=20)
        service.worker.steps = math.inf
        for name in ("first", "second", "third"):
            client.submit(tracks, mesh="none", name=name)
        view = read_view(client)
        assert (view.running + view.queued, [job.name for job in view.jobs][-1]) == (3, "done")
        console = Console(width=160, record=True)
        console.print(draw(view))
        text = console.export_text()
        assert f"{view.running} running, {view.queued} queued" in text
        assert "redis ok" in text


def test_top_once_and_json_print_and_exit(service: InMemoryService) -> None:
    ran = CliRunner().invoke(app, ["top", "--once"], obj=Session(transport=service))
    assert (ran.exit_code, "0 running, 0 queued" in ran.stdout) == (0, True), ran.output
    ran = CliRunner().invoke(app, ["top", "--json"], obj=Session(transport=service))
    assert json.loads(ran.stdout)["parts"]["redis"] == "ok"

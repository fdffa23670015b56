"""The progress display: visible on terminals, silent elsewhere."""

from __future__ import annotations

import io
import sys
from datetime import UTC, datetime

import numpy as np
import pytest
from pliant.client import Client, PliantError, Progress, Retry
from pliant.client.plot import draw
from pliant.client.progress import Bar, describe, progress_bar
from pliant.service.testing import InMemoryService
from rich.console import Console

POINTS = np.random.default_rng(1).normal(size=(4, 9, 2))


class Bars:
    """Stand-in for rich's progress bars that records the updates."""

    def __init__(self) -> None:
        self.shown: list[tuple[str, float]] = []

    def add_task(self, *_: object, **__: object) -> int:
        return 0

    def update(self, _: int, *, description: str, completed: float, note: str) -> None:
        self.shown.append((str(description), completed))


def test_the_bar_handles_every_callback_of_the_sdk() -> None:
    bars = Bars()
    bar = Bar(bars)
    with Client("http://pliant.test", transport=InMemoryService(steps=3), retries=Retry(poll_interval=0.01)) as client:
        result = client.submit(POINTS, on_upload=bar.on_upload).wait(on_progress=bar.on_progress)
        result.download(result.folder / "more", on_download=bar.on_download)
    stages = [stage for stage, _ in bars.shown]
    assert list(dict.fromkeys(stages)) == [
        "sending",
        "queued",
        "running",
        "loading",
        "reweight",
        "exporting",
        "succeeded",
        "fetching",
    ]
    assert all(0 <= fraction <= 1 for _, fraction in bars.shown)


def test_progress_is_shown_on_terminals_only() -> None:
    for terminal in (True, False):
        screen = io.StringIO()
        with progress_bar(Console(file=screen, force_terminal=terminal)) as bar:
            bar.on_upload(5, 10)
        assert ("sending" in screen.getvalue()) == terminal


def test_brackets_in_a_file_name_are_shown_as_they_are() -> None:
    screen = io.StringIO()
    with progress_bar(Console(file=screen, force_terminal=True, width=200)) as bar:
        bar.label = "take[/2] [red].npz"
        bar.on_upload(5, 10)
    assert bar.label in screen.getvalue()


def test_progress_is_described() -> None:
    now = datetime.now(UTC)
    assert describe(Progress(stage="loading", fraction=0, updated_at=now)) == ""
    full = Progress(
        stage="reweight",
        fraction=0.5,
        reweighting=3,
        max_reweightings=30,
        residual=0.25,
        seconds_left=6.2,
        updated_at=now,
    )
    assert describe(full) == "reweighting 3, residual 0.25, 7 s left"
    assert describe(full.model_copy(update={"seconds_left": 0.01})).endswith(", 1 s left"), "0 only at the end"
    assert describe(full.model_copy(update={"seconds_left": 0.0})).endswith(", 0 s left")


def test_a_plot_without_matplotlib_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(PliantError, match="pip install matplotlib"):
        draw(np.zeros((4, 9, 3)), np.zeros((0, 3), dtype=np.int32), 2, title="")

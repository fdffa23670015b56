"""`pliant track` writes tracks and a preview, and rejects unusable films with a message."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import films
import numpy as np
import pytest
from PIL import Image
from pliant.cli import app
from pliant.tracking.records import TrackingStep
from typer.testing import CliRunner


def test_a_film_becomes_tracks_and_a_preview(tmp_path: Path) -> None:
    film = films.write_film(tmp_path / "film.mkv", films.textured_pictures(10, (96, 72)))
    mask = np.zeros((72, 96), np.uint8)
    mask[20:55, 20:70] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    files = [str(film), "--region", str(tmp_path / "mask.png"), "-o", str(tmp_path / "tracks.npz")]
    ran = CliRunner().invoke(app, ["track", *files, "--preview", str(tmp_path / "sheet.jpg"), "--json"])
    assert ran.exit_code == 0, ran.output
    report = json.loads(ran.stdout)
    with np.load(tmp_path / "tracks.npz") as stored:
        assert stored["tracks"].shape == (10, report["points"], 2)
        np.testing.assert_allclose(np.median(np.diff(stored["tracks"], axis=0), axis=(0, 1)), [1, 0], atol=0.1)
    with Image.open(tmp_path / "sheet.jpg") as sheet:
        assert sheet.format == "JPEG"
    ran = CliRunner().invoke(app, ["track", *files, "--frames", ":4", "--force"])
    assert "points in 4 frames" in ran.stdout
    assert "Only 4 frames" in ran.stderr


def test_progress_lines_are_printed_without_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = importlib.import_module("pliant.cli.track")
    monkeypatch.setattr(module, "LINE_EVERY", 0.02)
    printed = ""
    steps = {
        "waiting": None,
        "read 30 frames": TrackingStep(stage="read", done=30, total=None),
        "track 25%": TrackingStep(stage="track", done=5, total=20),
    }
    with module._bars() as on_step:
        for line, step in steps.items():
            if step is not None:
                on_step(step)
            while f" s: {line}\n" not in printed:  # a thread prints them
                printed += capsys.readouterr().err
    assert all(re.fullmatch(rf"\d+ s: ({'|'.join(steps)})", line) for line in printed.splitlines()), printed


def test_a_playlist_is_rejected_with_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "film.mp4").write_text("#EXTM3U\n/etc/passwd\n")
    ran = CliRunner().invoke(app, ["track", str(tmp_path / "film.mp4"), "-o", str(tmp_path / "tracks.npz")])
    assert ran.exit_code == 3, ran.output
    assert "other files and addresses are never opened" in " ".join(ran.output.split())

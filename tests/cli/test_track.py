"""`pliant track` writes tracks and a preview, and rejects unusable films with a message."""

from __future__ import annotations

import json
from pathlib import Path

import films
import numpy as np
import pytest
from PIL import Image
from pliant.cli import app
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


def test_a_playlist_is_rejected_with_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "film.mp4").write_text("#EXTM3U\n/etc/passwd\n")
    ran = CliRunner().invoke(app, ["track", str(tmp_path / "film.mp4"), "-o", str(tmp_path / "tracks.npz")])
    assert ran.exit_code == 3, ran.output
    assert "other files and addresses are never opened" in " ".join(ran.output.split())

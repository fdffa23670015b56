"""`pliant track` writes tracks and a preview, and rejects unusable films with a message."""

from __future__ import annotations

import errno
import importlib
import json
import re
from pathlib import Path
from typing import IO

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


def test_a_file_of_tracks_is_no_film(tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=np.zeros((5, 9, 2)))
    ran = CliRunner().invoke(app, ["track", str(tmp_path / "tracks.npz"), "-o", str(tmp_path / "out.npz"), "--json"])
    document = json.loads(ran.stderr)
    assert (ran.exit_code, document["code"]) == (3, "tracks_as_film")
    assert "command line: pliant solve tracks.npz" in document["hint"]


def test_a_file_of_the_command_is_not_replaced_by_another(tmp_path: Path) -> None:
    film = films.write_film(tmp_path / "film.mkv", films.textured_pictures(4, (96, 72)))
    before = film.read_bytes()
    for given in (["-o", "tracks.npz", "--preview", "tracks.npz"], ["-o", "film.mkv", "--force"]):
        files = [name if name.startswith("-") else str(tmp_path / name) for name in given]
        ran = CliRunner().invoke(app, ["track", str(film), *files])
        assert ran.exit_code == 3, ran.output
        assert "is also another file of this command" in " ".join(ran.output.split())
    assert [each.name for each in tmp_path.iterdir()] == ["film.mkv"]
    assert film.read_bytes() == before


def test_earlier_tracks_survive_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = films.write_film(tmp_path / "film.mkv", films.textured_pictures(4, (96, 72)))
    (tmp_path / "tracks.npz").write_bytes(b"earlier")

    def full(stream: IO[bytes], **arrays: object) -> None:
        stream.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    ran = CliRunner().invoke(app, ["track", str(film), "-o", str(tmp_path / "tracks.npz"), "--force"])
    assert ran.exit_code == 3, ran.output
    assert (tmp_path / "tracks.npz").read_bytes() == b"earlier"
    assert {each.name for each in tmp_path.iterdir()} == {"film.mkv", "tracks.npz"}


def test_names_with_brackets_are_printed_in_full(tmp_path: Path) -> None:
    film = films.write_film(tmp_path / "film.mkv", films.textured_pictures(4, (96, 72)))
    ran = CliRunner().invoke(app, ["track", str(film), "-o", str(tmp_path / "tracks[final].npz")])
    assert "tracks[final].npz: " in ran.stdout


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

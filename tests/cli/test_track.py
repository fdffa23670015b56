"""`pliant track` writes tracks and a preview, and rejects unusable films with a message."""

from __future__ import annotations

import errno
import importlib
import json
import os
import re
import sys
from pathlib import Path
from typing import IO

import films
import numpy as np
import pytest
from PIL import Image
from pliant.cli import app
from pliant.cli.paths import write_aside
from pliant.tracking import FilmError
from pliant.tracking.records import TrackingStep
from typer.testing import CliRunner, Result


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A film for tests that do not look at its tracks."""
    return films.write_film(tmp_path / "film.mkv", films.textured_pictures(4, (48, 36)))


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
    assert "sheet" not in ran.stdout


def test_the_preview_is_named_in_the_output(small: Path, tmp_path: Path) -> None:
    files = [
        "track",
        str(small),
        "-o",
        str(tmp_path / "tracks.npz"),
        "--preview",
        str(tmp_path / "sheet.jpg"),
        "--force",
    ]
    ran = CliRunner().invoke(app, files)
    assert f"{tmp_path / 'sheet.jpg'}: the tracks over 4 of the frames." in ran.stdout
    assert json.loads(CliRunner().invoke(app, [*files, "--json"]).stdout)["preview"] == str(tmp_path / "sheet.jpg")


def test_warnings_are_printed_once_and_before_the_work_they_are_about(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tracker's survey stops here, so that only what was known before the film was read has been printed."""
    files = ["track", str(small), "-o", str(tmp_path / "tracks.npz")]
    ran = CliRunner().invoke(app, files)
    sentences = ["No region was given, so everything in the picture is tracked", "Only 4 frames are tracked."]
    for sentence in sentences:
        assert ran.stderr.count(sentence) == 1
    assert ran.stderr.index(sentences[0]) < ran.stderr.index(sentences[1])

    def stopped(*given: object, **options: object) -> None:
        raise FilmError("damaged_file", field="film", expected="a film", got="none", hint="Stop here.")

    for stage, seen in (("survey", sentences[:1]), ("chain", sentences)):
        with monkeypatch.context() as patch:
            patch.setattr(importlib.import_module("pliant.tracking.track"), stage, stopped)
            ran = CliRunner().invoke(app, [*files, "--force"])
        assert ran.exit_code == 3
        assert [sentence for sentence in sentences if sentence in ran.stderr] == seen


def test_a_photograph_is_no_mask(tmp_path: Path) -> None:
    pictures = films.textured_pictures(4, (96, 72))
    film = films.write_film(tmp_path / "film.mkv", pictures)
    Image.fromarray(pictures[0]).save(tmp_path / "photo.png")
    ran = CliRunner().invoke(
        app, ["track", str(film), "--region", str(tmp_path / "photo.png"), "-o", str(tmp_path / "tracks.npz"), "--json"]
    )
    document = json.loads(ran.stderr)
    assert (ran.exit_code, document["code"], document["field"]) == (3, "wrong_region", "region")
    assert document["explained_at"] == "pliant explain wrong_region"


def test_a_file_of_tracks_is_no_film(tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=np.zeros((5, 9, 2)))
    ran = CliRunner().invoke(app, ["track", str(tmp_path / "tracks.npz"), "-o", str(tmp_path / "out.npz"), "--json"])
    document = json.loads(ran.stderr)
    assert (ran.exit_code, document["code"]) == (3, "tracks_as_film")
    assert "command line: pliant solve tracks.npz" in document["hint"]


def test_a_file_of_the_command_is_not_replaced_by_another(small: Path, tmp_path: Path) -> None:
    before = small.read_bytes()
    for given in (["-o", "tracks.npz", "--preview", "tracks.npz"], ["-o", "film.mkv", "--force"]):
        files = [name if name.startswith("-") else str(tmp_path / name) for name in given]
        ran = CliRunner().invoke(app, ["track", str(small), *files])
        assert ran.exit_code == 3, ran.output
        assert "is also another file of this command" in " ".join(ran.output.split())
    assert [each.name for each in tmp_path.iterdir()] == ["film.mkv"]
    assert small.read_bytes() == before


def track(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["track", *map(str, arguments)], env={"COLUMNS": "400"})


def not_tracked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let tracking fail the test."""
    monkeypatch.setattr("pliant.tracking.track_film", lambda *given, **options: pytest.fail("the film was tracked"))


@pytest.mark.parametrize(
    ("output", "preview", "expected"),
    [
        ("x.csv", "sheet.jpg", "--output: expected a name that ends in .npz"),
        ("x", "sheet.jpg", "--output: expected a name that ends in .npz"),
        ("x.npz", "sheet.gif", "--preview: expected a name that ends in .jpg, .jpeg or .png"),
        ("x" * 252 + ".npz", "sheet.jpg", "File name too long"),
    ],
)
def test_names_that_do_not_fit_the_files_are_refused_before_tracking(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str, preview: str, expected: str
) -> None:
    film = films.write_film(tmp_path / "film.mkv", films.textured_pictures(4, (96, 72)))
    not_tracked(monkeypatch)
    ran = track(film, "-o", tmp_path / output, "--preview", tmp_path / preview)
    assert ran.exit_code == 3, ran.output
    assert expected in " ".join(ran.output.split())
    assert [each.name for each in tmp_path.iterdir()] == ["film.mkv"]


def test_a_file_may_have_the_longest_name(tmp_path: Path) -> None:
    with write_aside(tmp_path / ("x" * 251 + ".npz")) as aside:
        aside.write_text("content")
        assert aside.parent == tmp_path
    assert [each.name for each in tmp_path.iterdir()] == ["x" * 251 + ".npz"]


@pytest.mark.parametrize(("name", "starts"), [("a.JPEG", b"\xff\xd8\xff"), ("a.PNG", b"\x89PNG\r\n")])
def test_the_preview_has_the_format_of_its_name(tmp_path: Path, name: str, starts: bytes) -> None:
    film = films.write_film(tmp_path / "film.mkv", films.textured_pictures(4, (48, 36)))
    assert track(film, "-o", tmp_path / "A.NPZ", "--preview", tmp_path / name).exit_code == 0
    assert (tmp_path / name).read_bytes().startswith(starts)


def test_a_preview_is_no_frame_of_the_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "film"
    folder.mkdir()
    for number, picture in enumerate(films.textured_pictures(4, (48, 36))):
        (folder / f"{number}.png").write_bytes(films.png(picture))
    with monkeypatch.context() as patch:
        not_tracked(patch)
        ran = track(folder, "-o", tmp_path / "x.npz", "--preview", folder / "." / "sheet.jpg")
    assert ran.exit_code == 3, ran.output
    assert "--preview: expected a file outside the film's folder" in " ".join(ran.output.split())
    assert len(list(folder.iterdir())) == 4
    assert track(folder, "-o", folder / "x.npz", "--preview", tmp_path / "sheet.jpg").exit_code == 0


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
@pytest.mark.usefixtures("forked_readers")
def test_a_name_that_is_no_utf_8_is_refused(tmp_path: Path) -> None:
    film = Path(os.fsdecode(bytes(tmp_path) + b"/bad\xff.mkv"))
    films.write_film(tmp_path / "film.mkv", films.textured_pictures(4, (96, 72))).rename(film)
    for command in (["track", "-o", "x.npz"], ["solve", "-o", str(tmp_path / "out")], ["inspect"]):
        ran = CliRunner().invoke(app, [command[0], str(film), *command[1:]], env={"COLUMNS": "400"})
        assert ran.exit_code == 3, ran.output
        assert "bad?.mkv. Rename the file or folder." in " ".join(ran.output.split())


def test_earlier_tracks_survive_a_full_disk(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tracks.npz").write_bytes(b"earlier")

    def full(stream: IO[bytes], header: object) -> None:
        stream.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array_header_1_0", full)
    ran = CliRunner().invoke(app, ["track", str(small), "-o", str(tmp_path / "tracks.npz"), "--force"])
    assert ran.exit_code == 3, ran.output
    assert (tmp_path / "tracks.npz").read_bytes() == b"earlier"
    assert {each.name for each in tmp_path.iterdir()} == {"film.mkv", "tracks.npz"}


def test_names_with_brackets_are_printed_in_full(small: Path, tmp_path: Path) -> None:
    ran = CliRunner().invoke(app, ["track", str(small), "-o", str(tmp_path / "tracks[final].npz")])
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
    with module._bars() as (on_step, _):
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

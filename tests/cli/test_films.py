"""`pliant solve` accepts films, writes their tracks beside the shapes, and rejects unrelated inputs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import films
import numpy as np
import pytest
from PIL import Image
from pliant.cli import app
from pliant.cli.exits import Exit
from pliant.cli.session import Session
from pliant.client.errors import BadArgument
from pliant.service.testing import InMemoryService
from typer.testing import CliRunner, Result

forked = pytest.mark.usefixtures("forked_readers")
QUICK = ["-O", "outputs=[]", "-O", "max_reweightings=2", "-O", "grid_step=6", "-O", "refine_rotations=false"]
QUICK += ["-O", "prior=smooth", "-O", "surface=free", "-O", "camera=orthographic"]


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("film")
    mask = np.zeros((72, 96), np.uint8)
    mask[20:55, 20:70] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    return films.write_film(folder / "film.mp4", films.textured_pictures(10, (96, 72)))


def solve(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["solve", *map(str, arguments)], env={"COLUMNS": "200"})


def test_a_film_is_solved_and_its_tracks_are_written_beside_the_shapes(film: Path, tmp_path: Path) -> None:
    ran = solve(film, "--region", film.with_name("mask.png"), "-o", tmp_path, "--json", "--threads", 1, *QUICK)
    assert ran.exit_code == 0, ran.output
    files = json.loads(ran.stdout)["files"]
    assert list(files)[:2] == ["tracks.npz", "contact_sheet.jpg"]
    assert all(Path(path).is_file() for path in files.values())
    with np.load(files["tracks.npz"]) as tracks, np.load(files["shapes.npz"]) as shapes:
        assert shapes["shapes"].shape[:2] == tracks["tracks"].shape[:2]
        assert {"visibility", "confidence", "image_size"} <= set(tracks.files)
    options = json.loads(Path(files["report.json"]).read_text())["options"]
    assert (options["fps"], options["image_size"]) == (30.0, "96x72")
    words = solve(film, "-o", tmp_path, "--force", "-O", "frames=:5", *QUICK).output
    assert "A film of 96×72 pixels, 5 of 10 frames, 30 frames per second." in words
    assert words.count("No region was given") == 1
    assert words.count("Only 5 frames are tracked") == 1
    assert words.index("No region was given") < words.index("metric")
    assert "also contains" not in words


@forked
def test_warnings_of_a_film_are_printed_once_before_its_points_are_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = (films.textured_pictures(10, (96, 72), seed=seed) for seed in (0, 7))
    film = films.write_film(tmp_path / "film.mkv", one + other)
    monkeypatch.setattr("pliant.cli.films.LINE_EVERY", 0.02)
    words = solve(film, "-o", tmp_path / "out", *QUICK).output
    cut = "The film has a cut (at frame 10). Only frames 0 to 9 are tracked."
    assert words.count(cut) == words.count("No region was given") == 1
    assert words.index(cut) < words.index("cameras")


@forked
def test_invalid_films_and_parts_are_rejected_with_a_message(film: Path, tmp_path: Path) -> None:
    ran = solve(film, "--mesh", "3x4", "-o", tmp_path)
    assert ran.exit_code == Exit.REFUSED
    assert "--mesh: expected tracks, got a film" in ran.output
    ran = solve(film, "-o", tmp_path, "-O", "template_frame=99", *QUICK)
    assert ran.exit_code == Exit.REFUSED
    assert "options.template_frame" in ran.output
    (tmp_path / "list.mp4").write_text("#EXTM3U\n/etc/passwd\n")
    ran = solve(tmp_path / "list.mp4", "-o", tmp_path)
    assert ran.exit_code == Exit.REFUSED
    assert "other files and addresses are never opened" in " ".join(ran.output.split())


@pytest.mark.slow
@forked
def test_inspect_describes_a_film(film: Path, tmp_path: Path) -> None:
    def inspect(*arguments: object) -> Result:
        return CliRunner().invoke(app, ["inspect", *map(str, arguments)], env={"COLUMNS": "200"})

    ran = inspect(film, "--region", film.with_name("mask.png"), "--json")
    assert ran.exit_code == 0, ran.output
    read = json.loads(ran.stdout)
    assert (read["format"], read["num_frames"], read["image_size"]) == ("film (mp4)", 10, "96x72"), "as from a service"
    facts = read["film"]
    assert (facts["width"], facts["height"], facts["frames"], facts["fps"], facts["rotation"]) == (96, 72, 10, 30.0, 0)
    assert facts["seconds"] == pytest.approx(1 / 3)
    assert 0 < facts["track_seconds"] < 60
    assert 1e8 < read["estimate"]["memory_bytes"] < 1e9
    assert read["estimate"]["seconds"] > 0
    everything = json.loads(inspect(film, "--json").stdout)
    assert 0 < facts["points"] < 0.5 * everything["film"]["points"]
    words = " ".join(inspect(films.turned_by_90(copied(film, tmp_path)), "-O", "frames=::2").output.split())
    for each in (
        "size 72×96 pixels",
        "frames 5 of 10",
        "rate 15 frames per second by the file; the result has that of its tracked frames",
        "rotation 90°, applied",
    ):
        assert each in words
    times = r"time about (\d+) s: tracking (\d+) s, reconstruction (\d+) s on one core memory about \d\.\d GB"
    ((total, tracking, solving),) = re.findall(times, words)
    assert abs(int(total) - int(tracking) - int(solving)) <= 1  # each is rounded
    assert "-O surface=free omits it" in words
    assert "surface=free" not in inspect(film, "-O", "surface=free").output
    uneven = films.with_uneven_times(copied(film, tmp_path), first=3)
    assert "by the file; the result has that of its tracked frames" in " ".join(inspect(uneven).output.split())
    rate = r"rate +\S+ frames per second by the file\n"
    assert re.search(rate, re.sub(" +\n", "\n", inspect(uneven, "-O", "fps=12").output)), "the option decides"
    assert read["warnings"] == []
    assert [each[:19] for each in everything["warnings"]] == ["No region was given"]
    assert "warning No region was given" in words
    assert "warning region_frame has no effect without a region." in " ".join(
        inspect(film, "-O", "region_frame=3").output.split()
    )
    assert "warning Only 5 frames are tracked." in words
    blank = [np.full((72, 96, 3), 40 + shade, np.uint8) for shade in range(4)]
    dark = films.write_film(tmp_path / "dark.mp4", [*blank, *films.textured_pictures(4, (96, 72))])
    assert "note Frame 2 shows no texture that can be tracked." in " ".join(
        inspect(dark, "-O", "region_frame=2").output.split()
    )
    assert "warning" not in inspect(film, "-O", "region_polygon=[[20,20],[70,20],[70,55]]").output
    assert "note Not used for films: layout." in " ".join(inspect(film, "-O", "layout=points_frames").output.split())
    contradiction = ("-O", "focal=500", "-O", "field_of_view=60")
    for refused in (inspect(film, *contradiction), solve(film, "-o", tmp_path / "out", *contradiction)):
        assert refused.exit_code == Exit.REFUSED
        assert "field_of_view" in refused.output
        assert "tracking" not in refused.output
    refused = inspect(film, "--mesh", "3x4")
    assert refused.exit_code == Exit.REFUSED
    assert "--mesh: expected tracks, got a film" in refused.output
    for name in ("region_frame", "template_frame"):
        refused = inspect(film, "-O", f"{name}=1000")
        assert refused.exit_code == Exit.REFUSED
        assert f"options.{name}: expected a frame number from 0 to 9, got 1000." in refused.output


@forked
def test_a_folder_of_two_pictures_and_tracks_is_described_as_it_was_read(tmp_path: Path) -> None:
    for number in range(2):
        (tmp_path / f"{number}.png").write_bytes(films.png(np.zeros((48, 64, 3), np.uint8)))
    np.savez(tmp_path / "tracks.npz", tracks=np.zeros((5, 9, 2)))
    ran = CliRunner().invoke(app, ["inspect", str(tmp_path)], env={"COLUMNS": "400"})
    assert ran.exit_code == Exit.REFUSED
    assert (
        f"film: expected at least 3 frames, got 2 pictures in {tmp_path.name}, read as a folder of pictures. "
        "Add the other frames of the film. For a track file, give its own path."
    ) in " ".join(ran.output.split())


def copied(film: Path, folder: Path) -> Path:
    copy = folder / film.name
    copy.write_bytes(film.read_bytes())
    return copy


@forked
def test_a_film_without_a_region_gets_its_warning_before_it_is_tracked(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*given: object, **options: object) -> None:
        raise BadArgument("Stopped before the film is tracked.")

    monkeypatch.setattr("pliant.worker.execution.film.reconstruct_film", stopped)
    ran = solve(film, "-o", tmp_path)
    assert "No region was given" in ran.stderr
    assert "Stopped" in ran.stderr
    assert "No region" not in solve(film, "-o", tmp_path, "--region", film.with_name("mask.png")).stderr


@pytest.mark.slow
@forked
def test_folders_of_pictures_are_sent_as_zips(tmp_path: Path) -> None:
    pictures = [films.png(each) for each in films.textured_pictures(4, (96, 72))]
    for folder in (tmp_path / "first", tmp_path / "second"):
        folder.mkdir()
        for number, picture in enumerate(pictures):
            (folder / f"{number}.png").write_bytes(picture)
    submitting = [tmp_path / "first"], [tmp_path / "first", tmp_path / "second"]
    for given in submitting:
        ran = CliRunner().invoke(
            app,
            ["submit", *map(str, given), "--wait", "--json", *QUICK],
            obj=Session(transport=InMemoryService(steps=1)),
        )
        assert ran.exit_code == 0, ran.output
        jobs = [json.loads(ran.stdout)] if len(given) == 1 else [row["job"] for row in json.loads(ran.stdout)]
        assert [job["name"] for job in jobs] == [each.name for each in given]
        assert {job["interpretation"]["num_frames"] for job in jobs} == {4}


def test_the_result_of_a_films_tracks_repeats_the_trackers_warnings(film: Path, tmp_path: Path) -> None:
    tracks = tmp_path / "tracks.npz"
    tracked = CliRunner().invoke(app, ["track", str(film), "--frames", ":5", "-o", str(tracks)])
    assert tracked.exit_code == 0, tracked.output
    words = solve(tracks, "-o", tmp_path, "-O", "outputs=[]", "-O", "prior=smooth", "-O", "surface=free").output
    assert words.count("Only 5 frames are tracked") == words.count("No region was given") == 1
    assert "Only 5 frames are tracked" in json.loads((tmp_path / "report.json").read_text())["warnings"][1]

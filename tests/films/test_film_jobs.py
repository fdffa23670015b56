"""Films as inputs of jobs: the film process, its limits, and the resulting tracks."""

from __future__ import annotations

import base64
import errno
import io
import itertools
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import textwrap
import time
from contextlib import nullcontext
from pathlib import Path

import films
import numpy as np
import pytest
from PIL import Image
from pliant.schemas.film_limits import FilmLimits
from pliant.schemas.job import Progress
from pliant.schemas.options import Options
from pliant.service.local_result import read_result
from pliant.solver.errors import InvalidInput
from pliant.tracking import FilmError, open_film
from pliant.tracking import track_film as follow
from pliant.tracking.advice import warnings_before
from pliant.tracking.contact_sheet import small_jpeg
from pliant.tracking.records import Followed, TrackingStep
from pliant.tracking.survey import Survey
from pliant.worker.errors import Interrupted, InvalidRequest, TimedOut
from pliant.worker.execution.film import reconstruct_film, solving_seconds
from pliant.worker.execution.pace import MachinePace
from pliant.worker.films import frame_strip, tracker
from pliant.worker.films.bounds import FilmBounds
from pliant.worker.films.contained_process import SHARES, _followed
from pliant.worker.films.inputs import read_tracked
from pliant.worker.films.sources import FilmSource, is_source, looks_like_film, open_source, save_source
from pliant.worker.films.tracker import (
    FilmFacts,
    Tracked,
    believed_size,
    believed_warnings,
    described,
    film_options,
    read_film,
    track_film,
    with_estimate,
)
from pliant.worker.formats import Inputs
from pliant.worker.formats.cost import LIBRARIES, estimated
from pliant.worker.processes.contained import MAX_ANSWER, MAX_LINE, Ended, _Progress
from pliant.worker.processes.no_network import restrict_process
from pliant.worker.settings import Settings

SIZE = (96, 72)
forked = pytest.mark.usefixtures("forked_readers")


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A texture that moves to the right by one pixel per frame."""
    return films.write_film(tmp_path_factory.mktemp("film") / "film.mkv", films.textured_pictures(10, SIZE))


@pytest.fixture(scope="module")
def region(tmp_path_factory: pytest.TempPathFactory) -> Path:
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[20:55, 20:70] = 255
    path = tmp_path_factory.mktemp("region") / "mask.png"
    Image.fromarray(mask).save(path)
    return path


def refusal(source: FilmSource, options: Options = Options(), bounds: FilmBounds = FilmBounds()) -> InvalidInput:  # noqa: B008
    with pytest.raises(InvalidInput) as refused:
        read_film(source, options, bounds)
    return refused.value


@forked
def test_the_estimate_of_a_film_is_limited_like_its_check(film: Path) -> None:
    source = FilmSource(film)
    read = read_film(source, Options(max_points=40))
    assert read.interpretation.estimate is None
    estimate = with_estimate(read, source, threads=1).interpretation.estimate
    assert estimate is not None
    assert estimate.tracking_seconds is not None
    assert estimate.tracking_seconds > 0
    assert estimate.seconds == estimated(10, 40, read.options).seconds
    with pytest.raises(InvalidInput) as refused:
        with_estimate(read, source, FilmBounds(check_seconds=0.01), threads=1)
    assert refused.value.code == "too_slow"


@forked
def test_a_film_is_checked_without_being_tracked(film: Path, region: Path) -> None:
    facts = read_film(FilmSource(film, region), Options(frames="2:10:2")).facts
    assert (facts.container, facts.width, facts.height, facts.fps) == ("matroska", *SIZE, 15.0)
    options = film_options(Options(), facts)
    assert (options.image_size, options.fps) == ("96x72", 15.0)
    assert film_options(Options(fps=24), facts).fps == 24
    stated = described(facts, options)
    assert stated.mesh_source == "film"
    assert read_film(FilmSource(film, region), Options()).interpretation.has_region
    assert read_film(FilmSource(film), Options(region_polygon=[(1, 1), (9, 1), (1, 9)])).interpretation.has_region
    assert not read_film(FilmSource(film), Options()).interpretation.has_region
    assert "96×72 pixels" in stated.notes[0]


@forked
def test_a_film_of_equal_frames_is_refused_when_it_is_checked_and_one_that_begins_with_them_is_not(
    tmp_path: Path,
) -> None:
    pictures = films.textured_pictures(3, SIZE)
    still = films.write_film(tmp_path / "still.mkv", pictures[:1] * 20)
    assert refusal(FilmSource(still)).code == "undecodable_film"
    begins = films.write_film(tmp_path / "begins.mkv", [*pictures[:1] * 18, *pictures[1:]])
    assert read_film(FilmSource(begins), Options()).facts.frames == 20


@forked
def test_a_film_has_its_own_size_and_no_use_for_options_of_tracks(film: Path) -> None:
    facts = read_film(FilmSource(film), Options()).facts
    assert film_options(Options(image_size="96x72"), facts).image_size == "96x72"
    with pytest.raises(InvalidInput) as refused:
        film_options(Options(image_size="192x144"), facts)
    assert (refused.value.code, refused.value.field) == ("invalid_option", "options.image_size")
    assert "96x72" in refused.value.expected
    notes = described(facts, film_options(Options(y_axis="up", layout="points_frames"), facts)).notes
    assert notes[1:] == ["Not used for films: layout, y_axis."]


@forked
def test_the_rate_of_pictures_is_said_to_be_assumed(tmp_path: Path) -> None:
    textured = films.textured_pictures(3, SIZE)
    pictures = films.zip_of(
        tmp_path / "pictures.zip", {f"{place}.png": films.png(each) for place, each in enumerate(textured)}
    )
    facts = read_film(FilmSource(pictures), Options()).facts
    sentence = "Pictures state no frame rate: unless the option fps is given, 30 frames per second are assumed."
    assert facts.fps == 30
    assert sentence in described(facts, film_options(Options(), facts)).notes
    film = films.write_film(tmp_path / "film.mp4", films.textured_pictures(6, SIZE))
    assert sentence not in described(read_film(FilmSource(film), Options()).facts, Options()).notes


@forked
def test_the_first_frame_of_the_whole_film_is_returned_on_request(film: Path, tmp_path: Path) -> None:
    assert read_film(FilmSource(film), Options()).facts.first_frame == ""
    for frames in ("", "4:10"):
        facts = read_film(FilmSource(film), Options(frames=frames) if frames else Options(), picture=True).facts
        with Image.open(io.BytesIO(base64.b64decode(facts.first_frame))) as picture:
            assert (picture.format, picture.size) == ("JPEG", SIZE)
            shown = np.asarray(picture, float)
        differences = [np.abs(shown - each).mean() for each in films.textured_pictures(10, SIZE)]
        assert np.argmin(differences) == 0
    large = np.full((900, 1200, 3), 128, np.uint8)
    pictures = films.zip_of(tmp_path / "large.zip", {f"{number}.png": films.png(large) for number in range(3)})
    facts = read_film(FilmSource(pictures), Options(), picture=True).facts
    with Image.open(io.BytesIO(base64.b64decode(facts.first_frame))) as picture:
        assert picture.size == (800, 600)
    assert (facts.width, facts.height) == (1200, 900)


@forked
def test_an_incompressible_first_frame_fits_the_answer(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (900, 900, 3), dtype=np.uint8)
    pictures = films.zip_of(tmp_path / "noise.zip", {f"{number}.png": films.png(noise) for number in range(3)})
    assert len(read_film(FilmSource(pictures), Options(), picture=True).facts.first_frame) < MAX_ANSWER / 1.5


@forked
def test_a_mask_among_the_pictures_of_a_film_is_refused(tmp_path: Path, region: Path) -> None:
    """It would be a frame of the film."""
    (folder := tmp_path / "film").mkdir()
    for number, picture in enumerate(films.textured_pictures(4, SIZE)):
        Image.fromarray(picture).save(folder / f"{number}.png")
    mask = folder / "mask.png"
    mask.write_bytes(region.read_bytes())
    wrong = refusal(FilmSource(folder, mask))
    assert (wrong.code, wrong.got) == ("wrong_region", "mask.png in it, which would be a frame of the film")
    with pytest.raises(FilmError, match="expected a mask outside the film's folder of pictures"):
        follow(folder, region=mask)
    mask.rename(tmp_path / "mask.png")
    assert read_film(FilmSource(folder, tmp_path / "mask.png"), Options()).facts.frames == 4


def test_a_selection_after_the_end_of_a_damaged_film_has_no_frames(tmp_path: Path) -> None:
    film = films.write_film(tmp_path / "film.mkv", films.textured_pictures(20, SIZE))
    film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    assert (open_film(film).stated_frames, sum(1 for _ in open_film(film).frames()) < 15) == (20, True)
    wrong = refusal(FilmSource(film), Options(frames="16:20"))
    assert (wrong.code, wrong.got) == ("too_few_frames", "0")


def test_film_limits_come_from_the_settings(film: Path) -> None:
    settings = Settings(film_frames=8, film_pixels=5000, film_seconds=2)
    bounds = FilmBounds.of(settings, max_bytes=10**6)
    assert bounds.limits == FilmLimits(bytes=10**6, frames=8, pixels=5000, seconds=2.0)
    assert FilmBounds.of(Settings()).limits == FilmLimits()
    assert bounds.memory == settings.film_memory == FilmBounds().memory
    assert FilmBounds.of(Settings(memory_limit=1 << 30)).memory == 1 << 30
    assert FilmBounds.of(Settings(time_limit=7200)).track_seconds == 7200
    assert FilmBounds.of(Settings(time_limit=0)).track_seconds == FilmBounds().track_seconds == 7 * 24 * 3600
    assert refusal(FilmSource(film), bounds=bounds).code == "too_many_pixels"


@forked
def test_a_portrait_film_is_upright(tmp_path: Path) -> None:
    path = films.turned_by_90(films.write_film(tmp_path / "film.mp4", films.textured_pictures(6, SIZE)))
    facts = read_film(FilmSource(path), Options()).facts
    assert (facts.width, facts.height, facts.frames) == (72, 96, 6)


@pytest.mark.slow
@forked
def test_options_that_do_not_fit_the_film_are_rejected(film: Path, region: Path, tmp_path: Path) -> None:
    Image.new("L", (10, 10), 255).save(tmp_path / "small.png")
    wrong = refusal(FilmSource(film, tmp_path / "small.png"))
    assert (wrong.code, wrong.field) == ("wrong_region_size", "region")
    outside = Options(region_polygon=[(500, 500), (600, 500), (600, 600)])
    wrong = refusal(FilmSource(film), outside)
    assert (wrong.code, wrong.field) == ("empty_region", "options.region_polygon")
    assert refusal(FilmSource(film, region), outside).code == "conflicting_parts"
    assert refusal(FilmSource(film), Options(frames="-5:")).field == "options.frames"
    assert refusal(FilmSource(film), Options(frames="50:60")).code == "too_few_frames"
    assert refusal(FilmSource(film), bounds=FilmBounds(limits=FilmLimits(pixels=1000))).code == "too_many_pixels"
    assert refusal(FilmSource(film), bounds=FilmBounds(limits=FilmLimits(bytes=1000))).code == "too_many_bytes"
    for name, value in (("region_frame", 1000), ("template_frame", 1000), ("grid_step", 1.0)):
        wrong = refusal(FilmSource(film), Options(longest_side=64, **{name: value}))
        assert wrong.field == f"options.{name}"
        assert wrong.code == ("out_of_range" if name == "grid_step" else "no_such_frame")
    assert refusal(FilmSource(film), Options(frames="2:8", template_frame=1)).field == "options.template_frame"
    far = refusal(FilmSource(film, region), Options(frames="6:"), FilmBounds(limits=FilmLimits(frames=5)))
    assert (far.code, far.field) == ("too_many_frames", "options.region_frame")
    pictures = {f"{number}.png": films.png(each) for number, each in enumerate(films.textured_pictures(4))}
    many = films.zip_of(tmp_path / "many.zip", pictures)
    assert refusal(FilmSource(many), bounds=FilmBounds(limits=FilmLimits(frames=3))).code == "too_many_frames"


def test_too_little_memory_or_time_is_an_input_error(film: Path, tmp_path: Path) -> None:
    large = films.zip_of(tmp_path / "large.zip", {"1.png": films.png(np.zeros((2000, 3000, 3), np.uint8))})
    assert refusal(FilmSource(large), bounds=FilmBounds(memory=50 << 20)).code == "too_large"
    late = refusal(FilmSource(film), bounds=FilmBounds(check_seconds=0.01))
    assert late.code == "too_slow"
    assert "longest_side" in late.hint


def test_a_film_of_many_cuts_has_a_short_warning(film: Path) -> None:
    rows = np.arange(3000)
    found = Survey(
        rows, rows / 30, np.ones(3000), (0, 3000), tuple(range(6, 3000, 6)), np.ones(2, np.float32), broken_tail=False
    )
    warnings = tuple(warnings_before(open_film(film), found, 0, 6, whole=False, rough=1.0))
    assert "The film has 499 cuts (the first at frame 6). Only frames 0 to 5 are tracked." in warnings[0]
    assert Tracked(container="matroska", fps=30.0, warnings=warnings).warnings == warnings


@forked
def test_a_cut_is_reported_before_the_points_are_followed(tmp_path: Path) -> None:
    one, other = (films.textured_pictures(10, (96, 72), seed=seed) for seed in (0, 7))
    cut = films.write_film(tmp_path / "cut.mkv", one + other)
    (tmp_path / "scratch").mkdir()
    shares, known = [0.0], dict[str, float]()
    tracked = track_film(
        FilmSource(cut), Options(grid_step=6), tmp_path / "scratch",
        on_progress=lambda done, size, followed: shares.append(done),
        on_warnings=lambda warnings: known.update((each, shares[-1]) for each in warnings if each not in known),
    )  # fmt: skip
    assert list(known)[:2] == list(tracked.warnings[:2])
    assert "The film has a cut (at frame 10)" in list(known)[1]
    assert known[list(known)[1]] <= SHARES["read"][1] < shares[-1]


def test_each_exit_of_the_film_process_maps_to_an_error() -> None:
    def code_of(code: int, answer: bytes = b"") -> str:
        fault = tracker._fault(Ended(code, answer, ""), FilmBounds(), 1.0)
        assert isinstance(fault, InvalidInput)
        return fault.code

    assert code_of(-signal.SIGSEGV) == "damaged_file"
    assert code_of(-signal.SIGKILL) == "too_large"
    assert code_of(-signal.SIGXCPU) == "too_slow"
    assert code_of(3, b"no JSON") == code_of(3, b"[" * 100_000) == "damaged_file"
    assert isinstance(tracker._fault(Ended(1, b"", "Traceback"), FilmBounds(), 1.0), RuntimeError)
    with pytest.raises(InvalidInput, match="cannot read consistently"):
        tracker._answer(Tracked, Ended(0, b'{"container": 3}', ""), FilmBounds(), 1.0)
    facts = {
        "container": "mp4",
        "width": 2,
        "height": 2,
        "fps": 1,
        "stated_frames": 3,
        "frames": 3,
        "seconds": 3,
        "rotation": 0,
    }
    for first_frame, believed in (("AAAA", True), ("<svg/>", False)):
        answer = Ended(0, json.dumps({**facts, "pixel_aspect": 1, "first_frame": first_frame}).encode(), "")
        with nullcontext() if believed else pytest.raises(InvalidInput, match="cannot read consistently"):
            tracker._answer(FilmFacts, answer, FilmBounds(), 1.0)


@forked
def test_a_film_and_its_region_are_stored_byte_for_byte(film: Path, region: Path, tmp_path: Path) -> None:
    source = FilmSource(film, region)
    facts = read_film(source, Options()).facts
    save_source(source, described(facts, Options()), tmp_path / "inputs.npz")
    assert is_source(tmp_path / "inputs.npz")
    back = open_source(tmp_path / "inputs.npz", tmp_path / "back")
    assert back.film.read_bytes() == film.read_bytes()
    assert back.region is not None
    assert back.region.read_bytes() == region.read_bytes()
    assert back.names == {"film": film.name, "region": region.name}
    np.savez(tmp_path / "tracks.npz", tracks=np.zeros(3))
    (tmp_path / "text").write_text("no zip")
    assert not is_source(tmp_path / "tracks.npz")
    assert not is_source(tmp_path / "text")
    newer = films.zip_of(tmp_path / "newer.npz", {"film.json": b'{"version": 99}'})
    with pytest.raises(InvalidInput, match="version 99"):
        open_source(newer, tmp_path / "a")
    with pytest.raises(InvalidInput, match="cannot be read back"):
        open_source(films.zip_of(tmp_path / "bad.npz", {"film.json": b"[]"}), tmp_path / "b")


def test_films_are_told_apart_from_track_files_and_spreadsheets(film: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", tracks=np.zeros(3))
    np.save(tmp_path / "tracks.npy", np.zeros(3))
    (tmp_path / "list.mp4").write_text("#EXTM3U\n")
    (tmp_path / "broken.zip").write_bytes(b"PK\x03\x04")
    pictures = films.zip_of(tmp_path / "pictures.zip", {"1.png": b""})
    moved = tmp_path / "named-like-tracks.npy"
    moved.write_bytes(film.read_bytes())
    films.write_film(tmp_path / "a.avi", films.textured_pictures(3))
    scans = films.zip_of(
        tmp_path / "scans.zip", {"1.tif": b"", "2.tif": b""}
    )  # refused as a film, with the accepted formats
    given = (
        film,
        moved,
        pictures,
        scans,
        tmp_path,
        tmp_path / "list.mp4",
        tmp_path / "missing.mov",
        tmp_path / "a.avi",
        tmp_path / "refused.mts",
        tmp_path / "animated.png",
    )
    first, *others = [Image.fromarray(each) for each in films.textured_pictures(3)]
    first.save(tmp_path / "animated.png", save_all=True, append_images=others)
    first.save(tmp_path / "still.png")
    (tmp_path / "refused.mts").write_bytes(bytes(4) + b"G" + bytes(200))
    assert [path for path in given if not looks_like_film(path)] == []
    sheets = {
        "a.xlsx": ("[Content_Types].xml", "xl/workbook.xml", "xl/media/image1.png"),
        "a.ods": ("mimetype", "content.xml", "Thumbnails/thumbnail.png"),
    }
    for name, members in sheets.items():
        films.zip_of(tmp_path / name, dict.fromkeys(members, b""))
    names = ("tracks.npz", "tracks.npy", "broken.zip", "missing.npz", "still.png", *sheets)
    others = [tmp_path / name for name in names]
    assert [path for path in others if looks_like_film(path)] == []


def test_a_film_becomes_shapes_tracks_and_a_contact_sheet(film: Path, region: Path, tmp_path: Path) -> None:
    steps: list[Progress] = []
    (tmp_path / "scratch").mkdir()
    options = Options(outputs=(), max_reweightings=2, grid_step=6, refine_rotations=False, principal_point="60,30")
    options = film_options(options, read_film(FilmSource(film, region), options).facts)
    done = reconstruct_film(
        FilmSource(film, region), options, tmp_path / "out", scratch=tmp_path / "scratch", on_progress=steps.append
    )
    names = [each.name for each in done.artifacts]
    assert names[:2] == ["tracks.npz", "contact_sheet.jpg"]
    assert {"shapes.npz", "report.json"} < set(names)
    stages = [each.stage for each in steps]
    assert stages[0] == "track"
    assert stages.count("track") > 2
    assert [each.fraction for each in steps] == sorted(each.fraction for each in steps)
    assert steps[-1].fraction == 1.0
    with np.load(tmp_path / "out" / "tracks.npz") as tracks, np.load(tmp_path / "out" / "shapes.npz") as shapes:
        assert tracks["image_size"].tolist() == list(SIZE)
        assert shapes["shapes"].shape == (*tracks["tracks"].shape[:2], 3)
        assert tracks["tracks"][tracks["template"], :, 0].min() >= 20  # inside the region
    assert done.interpretation is not None
    assert done.interpretation.num_points == shapes_count(tmp_path / "out")
    assert done.interpretation.has_region
    assert done.interpretation.estimate == estimated(10, done.interpretation.num_points, done.options or options)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["seconds"]["track"] > 0
    assert {name: each["sha256"] for name, each in report["artifacts"].items()} == {
        each.name: each.sha256 for each in done.artifacts if each.name != "report.json"
    }
    assert report["warnings"] == list(done.warnings)
    assert "film_frames.bin" in {each.name for each in read_result(tmp_path / "out").artifacts}
    with Image.open(tmp_path / "out" / "contact_sheet.jpg") as sheet:
        assert sheet.format == "JPEG"
    check_followed(steps, tmp_path / "out")
    check_film_frames(tmp_path / "out", count=10)


@forked
def test_a_film_with_too_many_points_for_the_memory_is_refused_before_it_is_solved(
    film: Path, region: Path, tmp_path: Path
) -> None:
    (tmp_path / "scratch").mkdir()
    steps: list[Progress] = []
    with pytest.raises(InvalidRequest, match="for 10 frames") as refused:
        reconstruct_film(
            FilmSource(film, region), Options(), tmp_path / "out", scratch=tmp_path / "scratch",
            memory=LIBRARIES + 1000, on_progress=steps.append,
        )  # fmt: skip
    assert (refused.value.code, refused.value.field) == ("needs_more_memory", "film")
    assert refused.value.expected.endswith("the memory of this worker")
    assert {each.stage for each in steps} == {"track"}
    assert not (tmp_path / "out").exists()


@forked
def test_the_time_estimate_uses_the_measured_machine_pace(
    film: Path, region: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[Progress] = []
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(MachinePace, "measure", lambda self: 1000.0)
    with pytest.raises(Interrupted):
        reconstruct_film(
            FilmSource(film, region), Options(surface="free"), tmp_path / "out", scratch=tmp_path / "scratch",
            on_progress=steps.append, should_stop=lambda: any(each.seconds_left for each in steps),
        )  # fmt: skip
    shown = max(each.seconds_left or 0.0 for each in steps)
    assert shown > 1000 * solving_seconds(5, 10, Options(surface="free"))


def check_followed(steps: list[Progress], folder: Path) -> None:
    """Check that the points reported during tracking lie on the finished tracks."""
    followed = next(each.followed for each in steps if each.followed is not None)
    assert steps[-1].followed is None
    assert (followed.width, followed.height) == SIZE
    places = np.array(followed.points).reshape(-1, 2)
    assert 4 <= len(places) <= 150
    with np.load(folder / "tracks.npz") as file:
        row = int(np.flatnonzero(file["frame_indices"] == followed.frame)[0])
        assert followed.seconds == pytest.approx(file["frame_times"][row])
        apart = np.linalg.norm(places[:, None] - file["tracks"][row][None], axis=2).min(axis=1)
    assert np.median(apart) <= 0.71  # rounding to whole pixels


def test_the_points_shown_during_tracking_are_spread_over_the_object() -> None:
    across, down = np.meshgrid(np.arange(48), np.arange(36))
    places = np.stack([across, down], axis=2).reshape(-1, 2).astype(float)
    step = TrackingStep("track", 1, 9, Followed(1, 0.04, places, np.ones(len(places), bool)))
    shown = _followed(step, (48, 36))
    assert shown is not None
    columns, rows = np.array(shown["points"]).reshape(-1, 2).T
    assert len(columns) == 150
    assert len(set(columns.tolist())) > 40, "every twelfth point would be four of the 48 columns"
    assert len(set(rows.tolist())) > 30


def check_film_frames(folder: Path, *, count: int) -> None:
    """Read film_frames.bin by the layout in its docstring: one picture per tracked frame."""
    raw = (folder / "film_frames.bin").read_bytes()
    assert raw[:8] == b"PLIANTFF"
    version, length = struct.unpack_from("<II", raw, 8)
    header = json.loads(raw[16 : 16 + length])
    assert (version, header["width"], header["height"]) == (1, *SIZE)
    offsets = header["offsets"]
    assert len(offsets) == count + 1
    assert offsets[-1] == len(raw)
    pictures = [np.asarray(Image.open(io.BytesIO(raw[a:b]))) for a, b in itertools.pairwise(offsets)]
    assert {picture.shape for picture in pictures} == {(SIZE[1], SIZE[0], 3)}
    # The texture moves to the right by one pixel per frame.
    moved = np.abs(pictures[5][:, 5:].astype(float) - pictures[0][:, :-5]).mean()
    assert moved < 0.5 * np.abs(pictures[5].astype(float) - pictures[0]).mean()


def test_pictures_are_reduced_and_incomplete_or_large_strips_not_written(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wide = np.zeros((300, 960, 3), np.uint8)
    with Image.open(io.BytesIO(small_jpeg(wide, longest_side=480, quality=80))) as picture:
        assert picture.size == (480, 150)
    opened = open_film(film)
    assert not frame_strip.write_frames(opened, np.array([0, 3, 99]), tmp_path / "a")  # the film has no frame 99
    monkeypatch.setattr(frame_strip, "MOST_BYTES", 1000)
    assert not frame_strip.write_frames(opened, np.arange(10), tmp_path / "a")
    assert not (tmp_path / "a").exists()


def shapes_count(folder: Path) -> int:
    with np.load(folder / "shapes.npz") as shapes:
        return int(shapes["shapes"].shape[1])


def test_stopping_kills_the_film_process(film: Path, tmp_path: Path) -> None:
    for name, options, should_stop, expected in (
        ("a", Options(), lambda: True, Interrupted),
        ("b", Options(time_limit=0.05), None, TimedOut),
    ):
        (tmp_path / name).mkdir()
        began = time.monotonic()
        with pytest.raises(expected):
            reconstruct_film(
                FilmSource(film), options, tmp_path / "out", scratch=tmp_path / name, should_stop=should_stop
            )
        assert time.monotonic() - began < 10
        assert not (tmp_path / "out").exists()
    (tmp_path / "c").mkdir()
    with pytest.raises(Interrupted):
        track_film(FilmSource(film), Options(), tmp_path / "c", should_stop=lambda: True)


def tracks_file(path: Path, **more: np.ndarray) -> Path:
    points = np.random.default_rng(0).uniform(0, 50, (4, 9, 2)).astype(np.float32)
    arrays = {"tracks": points, "visibility": np.ones((4, 9), bool), "confidence": np.full((4, 9), 0.5, np.float32),
              "grid": np.arange(9, dtype=np.int32).reshape(3, 3), "frame_times": np.arange(4.0),
              "image_size": np.array([64, 48]), "fps": np.array(30.0)}  # fmt: skip
    np.savez(path, **(arrays | more))
    return path


def test_tracker_confidence_becomes_the_observation_weight(tmp_path: Path) -> None:
    seen = np.ones((4, 9), bool)
    seen[1, 3] = False
    tracked = Tracked(container="mp4", fps=30.0, warnings=("Only 4 frames.",))
    inputs = read_tracked(tracks_file(tmp_path / "a.npz", visibility=seen), tracked, Options())
    assert isinstance(inputs, Inputs)
    assert inputs.tracks.visible[1, 3] == 0
    assert inputs.tracks.visible[0, 0] == 0.5
    assert inputs.interpretation.notes[-1] == "Only 4 frames."
    assert inputs.selection is None
    fewer = read_tracked(tmp_path / "a.npz", tracked, Options(stride=2))
    assert fewer.selection is not None
    assert fewer.tracks.num_points == 4
    with pytest.raises(InvalidInput, match="confidence of shape"):
        read_tracked(tracks_file(tmp_path / "b.npz", confidence=np.ones((3, 9))), tracked, Options())


@pytest.mark.skipif(sys.platform != "linux", reason="seccomp")
def test_the_film_process_has_no_network_and_starts_no_programs() -> None:
    script = textwrap.dedent("""
        import socket, subprocess, threading
        from pliant.worker.processes.no_network import restrict_process
        print(restrict_process())
        for attempt in (socket.socket, lambda: subprocess.run(["/bin/true"])):
            try:
                attempt()
            except PermissionError as error:
                print(error.errno)
        thread = threading.Thread(target=print, args=("thread",))
        thread.start()
        thread.join()
    """)
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["True", str(errno.EACCES), str(errno.EACCES), "thread"]
    socket.socket().close()  # this process is not restricted


def test_an_unknown_architecture_has_no_network_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "pdp11")
    assert not restrict_process()


def test_progress_is_passed_on_and_invalid_lines_dropped() -> None:
    heard: list[dict[str, object]] = []
    with _Progress(heard.append) as progress:
        assert progress.target is not None
        progress.read()
        for piece in (b'{"done": 0.5}\nnonsense\n[1]\n' + b"x" * (MAX_LINE + 1), b'{"done": 0.7}\n{"do', b'ne": 1}\n'):
            os.write(progress.target, piece)
            progress.read()
    assert heard == [{"done": 0.5}, {"done": 0.7}, {"done": 1}]


@pytest.mark.parametrize(
    "stated", [None, [30], [30, 0], [30, -1], [30, 1.5], [30, 1 << 30], ["30", "900"], {"frames": 30}]
)
def test_implausible_stated_sizes_are_ignored(stated: object) -> None:
    assert believed_size(stated) is None
    assert believed_size([30, 900]) == (30, 900)


@pytest.mark.parametrize("stated", [None, "warning", [1], ["x" * 1001], ["x"] * 101, {"warnings": []}])
def test_implausible_warnings_are_ignored(stated: object) -> None:
    assert believed_warnings(stated) == ()
    assert believed_warnings(["Film in one take."]) == ("Film in one take.",)


def test_the_time_estimate_includes_the_isometric_surface_search() -> None:
    free, auto = (
        solving_seconds(30, 900, Options(surface=surface, image_size="640x480")) for surface in ("free", "auto")
    )
    assert 1 < free < auto
    assert solving_seconds(60, 900, Options(surface="free", image_size="640x480")) > free

"""The region's frame and the template among the selected frames of a film."""

from __future__ import annotations

from pathlib import Path

import films
import numpy as np
import pytest
from pliant.tracking import FilmError, FilmLimits, TrackedFilm, open_film, track_film
from pliant.tracking.estimate import estimate
from pliant.tracking.region import REACH, _cover
from pliant.tracking.survey import middle_of

LEFT, RIGHT = 20, 50
REGION = [(LEFT, 20), (RIGHT, 20), (RIGHT, 50), (LEFT, 50)]
"""A region of the first frame; the texture moves to the right by two pixels per frame."""


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pictures = films.textured_pictures(16, (96, 72), step=2)
    return films.write_film(tmp_path_factory.mktemp("films") / "film.mkv", pictures)


@pytest.fixture(scope="module")
def two_shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    one, other = (films.textured_pictures(10, (96, 72), seed=seed) for seed in (0, 7))
    return films.write_film(tmp_path_factory.mktemp("films") / "film.mkv", one + other)


def extent(tracked: TrackedFilm) -> tuple[float, float]:
    """Return the left and right end of the points in the template."""
    across = tracked.tracks[tracked.template][:, 0]
    return float(across.min()), float(across.max())


@pytest.mark.parametrize(("frames", "used"), [("8:", range(8, 16)), ("8:12", range(8, 12)), ("8::2", range(8, 16, 2))])
def test_a_region_drawn_before_the_selected_frames_is_carried_to_them(film: Path, frames: str, used: range) -> None:
    tracked = track_film(film, region=REGION, frames=frames, grid_step=3)
    np.testing.assert_array_equal(tracked.film.frame_indices, list(used))
    template = tracked.film.frame_indices[tracked.template]
    assert tracked.template in middle_of(0, len(used))
    assert extent(tracked) == pytest.approx((LEFT + 2 * template, RIGHT + 2 * template), abs=4)
    assert tracked.warnings[0].startswith(f"Only {len(used)} frames are tracked.")


def test_a_region_drawn_after_the_selected_frames_is_carried_back_to_them(film: Path) -> None:
    tracked = track_film(film, region=REGION, region_frame=9, frames=":5", grid_step=3)
    np.testing.assert_array_equal(tracked.film.frame_indices, range(5))
    assert tracked.template in middle_of(0, 5)
    assert extent(tracked) == pytest.approx(
        (LEFT + 2 * (tracked.template - 9), RIGHT + 2 * (tracked.template - 9)), abs=4
    )


def test_a_region_moves_as_a_whole_with_its_visible_points() -> None:
    region = np.zeros((60, 80), bool)
    region[10:41, 12:53] = True
    rows, columns = np.mgrid[12:40:4, 14:52:4]
    before = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float32)
    moved = _cover(region, before, before + np.float32([7, 5]), 4.0, region.shape)
    np.testing.assert_array_equal(moved, np.roll(region, (5, 7), axis=(0, 1)))
    seen = before[:, 0] < 30
    part = _cover(region, before[seen], before[seen], 4.0, region.shape)
    across = np.flatnonzero(part.any(axis=0))
    assert (across[0], across[-1]) == (12, 26 + int(REACH * 4)), "up to the reach beyond the last visible point"
    assert not _cover(region, before[:0], before[:0], 4.0, region.shape).any()
    outside = _cover(region, before, before + np.float32([60, 0]), 4.0, region.shape)
    assert outside[:, :72].sum() == 0, "what leaves the picture is lost"


def test_without_a_region_only_selected_frames_are_read(film: Path) -> None:
    read: list[int] = []
    tracked = track_film(
        film,
        frames="8:14",
        grid_step=6,
        on_step=lambda step: read.append(step.done) if step.stage == "read" else None,
    )
    assert max(read) == len(tracked.tracks) == 6


def test_points_are_estimated_in_the_frame_of_the_region(tmp_path: Path) -> None:
    pictures = films.textured_pictures(12, (96, 72))
    pictures[6:] = [np.full_like(picture, 120) for picture in pictures[6:]]
    opened = open_film(films.write_film(tmp_path / "film.mkv", pictures), frames="6:")
    found = estimate(opened, region=REGION, region_frame=0, grid_step=3, longest_side=960, threads=1)
    assert found.points > 50


def test_a_region_far_from_the_selected_frames_is_refused(film: Path) -> None:
    with pytest.raises(FilmError) as caught:
        track_film(film, region=REGION, frames="8:", limits=FilmLimits(frames=7))
    assert (caught.value.code, caught.value.field) == ("too_many_frames", "region_frame")
    assert len(track_film(film, region=REGION, frames="8:", grid_step=3, limits=FilmLimits(frames=8)).tracks) == 8
    with pytest.raises(FilmError, match="expected at least 3 frames, got 2"):
        track_film(film, region=REGION, frames="14:")


def test_a_region_drawn_before_a_cut_is_not_used_after_it(two_shots: Path) -> None:
    with pytest.raises(FilmError) as caught:
        track_film(two_shots, region=REGION, frames="12:")
    assert (caught.value.code, caught.value.field) == ("region_lost", "region_frame")
    assert "drawn in frames 0 to 9, before or after a cut" in str(caught.value)
    tracked = track_film(two_shots, region=REGION, region_frame=11, frames="12:", grid_step=3)
    assert tracked.film.frame_indices[0] == 12


def test_a_template_in_another_shot_than_the_region_is_refused(two_shots: Path) -> None:
    with pytest.raises(FilmError) as caught:
        track_film(two_shots, region=REGION, template_frame=14)
    assert (caught.value.code, caught.value.field) == ("no_such_frame", "template_frame")
    assert "expected a frame of the region's shot, 0 to 9, got 14" in str(caught.value)


@pytest.mark.parametrize(
    ("frames", "template", "expected"),
    [
        ("8:", 7, "from 8 to 15"),
        ("8:12", 12, "from 8 to 11"),
        ("8:13:2", 6, "from 7 to 13"),
        ("8:13:2", 14, "from 7 to 13"),
        (None, 99, "from 0 to 15"),
    ],
)
def test_a_template_that_is_not_selected_is_refused_before_the_film_is_read(
    film: Path, frames: str | None, template: int, expected: str
) -> None:
    with pytest.raises(FilmError) as caught:
        track_film(film, frames=frames, template_frame=template, on_step=lambda step: pytest.fail("frames were read"))
    assert (caught.value.code, caught.value.field) == ("no_such_frame", "template_frame")
    assert f"expected a frame number {expected}, got {template}" in str(caught.value)


def test_a_skipped_frame_beside_the_selected_ones_stands_for_the_nearest(film: Path) -> None:
    for template, row in ((7, 0), (13, 2)):
        assert track_film(film, frames="8:13:2", template_frame=template, grid_step=6).template == row


def test_frames_of_a_region_beyond_the_film_are_refused_before_it_is_read(film: Path) -> None:
    with pytest.raises(FilmError, match="from 0 to 15, got 16") as caught:
        track_film(film, region=REGION, region_frame=16, on_step=lambda step: pytest.fail("frames were read"))
    assert (caught.value.code, caught.value.field) == ("no_such_frame", "region_frame")


def test_a_frame_beyond_a_film_that_states_no_length_is_refused_after_reading_it(tmp_path: Path) -> None:
    path = films.like_a_recording(films.write_film(tmp_path / "film.webm", films.textured_pictures(31, (96, 72))))
    assert open_film(path).stated_frames == 0
    for field in ("region_frame", "template_frame"):
        with pytest.raises(FilmError, match="expected a frame number from 0 to 30, got 31") as caught:
            track_film(path, region=REGION, **{field: 31})  # type: ignore[arg-type]
        assert (caught.value.code, caught.value.field) == ("no_such_frame", field)


@pytest.mark.parametrize("field", ["region_frame", "template_frame"])
@pytest.mark.parametrize("frame", [3.7, "4", -1])
def test_frame_numbers_are_whole_and_not_negative(film: Path, field: str, frame: object) -> None:
    with pytest.raises(FilmError) as caught:
        track_film(film, **{field: frame})  # type: ignore[arg-type]
    assert (caught.value.code, caught.value.field) == ("no_such_frame", field)


def test_numpy_integers_are_frame_numbers(film: Path) -> None:
    opened = open_film(film, frames=slice(np.int64(2), np.int64(8), np.int32(2)))
    assert opened.selection == (2, 8, 2)
    assert open_film(film, frames=np.int64(8)).selection == (0, None, 2)  # type: ignore[arg-type]
    assert track_film(opened, template_frame=np.int64(4), grid_step=6).template == 1  # type: ignore[arg-type]

"""The estimate of points and time for tracking a film."""

from __future__ import annotations

import itertools
from pathlib import Path

import films
import numpy as np
import pytest
from pliant.tracking import estimate as tracking_estimate
from pliant.tracking import open_film, track_film
from pliant.tracking.chaining import box_around
from pliant.tracking.estimate import FLOWS, LOCATING_FLOWS, Estimate, estimate

SIZE = (96, 72)


def taken(path: Path, region: np.ndarray | None = None, *, frames: str | None = None, threads: int = 1) -> Estimate:
    """Estimate tracking a film with a grid step of 3 pixels."""
    opened = open_film(path, frames=frames)
    return estimate(opened, region=region, region_frame=0, grid_step=3, longest_side=960, threads=threads)


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pictures = films.textured_pictures(40, SIZE)
    for picture in pictures:
        picture[:, 60:] = 120
    return films.write_film(tmp_path_factory.mktemp("films") / "film.mkv", pictures)


def test_estimated_points_equal_the_tracked_points(film: Path) -> None:
    region = np.zeros(SIZE[::-1], bool)
    region[12:60, 9:51] = True
    tracked = track_film(film, region=region, template_frame=0, grid_step=3, frames=":4")
    assert taken(film, region).points == tracked.tracks.shape[1]
    assert taken(film).points > 1.2 * taken(film, region).points


def test_estimated_time_scales_with_frames_and_threads(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert taken(film).seconds > 0
    clock = itertools.count()
    monkeypatch.setattr(tracking_estimate.time, "perf_counter", lambda: float(next(clock)))
    frame = FLOWS + 1.0  # a clock that ticks once between two readings: flows, and the rest of a frame
    assert taken(film).seconds == 40 * frame
    assert taken(film, frames=":4").seconds == 4 * frame
    assert taken(film, threads=8).seconds == 40 * frame / 8


def test_carrying_the_region_to_the_template_takes_time(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    region = np.zeros(SIZE[::-1], bool)
    region[12:60, 9:51] = True
    clock = itertools.count()
    monkeypatch.setattr(tracking_estimate.time, "perf_counter", lambda: float(next(clock)))

    def seconds(**given: int) -> float:
        more = {"region_frame": 0, **given}
        return estimate(open_film(film), region=region, grid_step=3, longest_side=960, threads=1, **more).seconds

    frames = 40 * (FLOWS + 1.0)
    assert seconds() == frames + 20 / 2 * LOCATING_FLOWS  # to the middle, two frames at once
    assert seconds(region_frame=20) == seconds(template_frame=0) == frames
    assert seconds(region_frame=39, template_frame=29) == frames + 10 / 2 * LOCATING_FLOWS


def test_flow_is_timed_in_the_box_in_which_it_is_computed(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    region = np.zeros(SIZE[::-1], bool)
    region[20:40, 9:30] = True
    timed = []
    monkeypatch.setattr(tracking_estimate, "_flow_seconds", lambda picture: timed.append(picture.shape) or 0.0)
    taken(film, region)
    scale = 3  # small films are enlarged
    rows, columns = box_around(np.array([(9.0, 20.0), (30.0, 40.0)]) * scale, (72 * scale, 96 * scale))
    assert np.abs(np.subtract(timed[0], (rows.stop - rows.start, columns.stop - columns.start))).max() <= 16
    assert timed[1] == (72 * scale, 96 * scale)


def test_a_coarse_grid_can_be_estimated(tmp_path: Path) -> None:
    path = films.write_film(tmp_path / "film.mkv", films.textured_pictures(3, (240, 180)))
    found = estimate(open_film(path), region=None, region_frame=0, grid_step=100, longest_side=960, threads=1)
    assert found.points == 4
    assert found.seconds > 0


def test_a_region_without_texture_is_estimated_at_zero_points(film: Path) -> None:
    region = np.zeros(SIZE[::-1], bool)
    region[12:60, 66:90] = True
    assert taken(film, region) == Estimate(0, 0.0)

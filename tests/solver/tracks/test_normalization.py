"""Normalization: position and unit are removed and restored."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import InvalidInput, Tracks
from pliant.solver.tracks.normalization import normalize


def some_tracks(seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return 40 * random.standard_normal((6, 30, 2)) + 300 * random.standard_normal((6, 1, 2))


def test_normalized_tracks_have_zero_centroid_and_unit_radius() -> None:
    points = some_tracks()
    found = normalize(Tracks.from_arrays(points))
    np.testing.assert_allclose(found.points.mean(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose((found.points**2).sum(axis=2).mean(), 1)
    np.testing.assert_allclose(found.unit * found.points + found.centroid[:, None], points)


def test_scale_and_position_of_the_input_do_not_matter() -> None:
    points = some_tracks()
    one, two = (normalize(Tracks.from_arrays(p)) for p in (points, 7.5 * points + [100.0, -3.0]))
    np.testing.assert_allclose(one.points, two.points, atol=1e-12)
    np.testing.assert_allclose(two.unit, 7.5 * one.unit)


def test_hidden_observations_have_no_effect_and_stay_zero() -> None:
    points = some_tracks()
    visible = np.random.default_rng(1).random((6, 30)) > 0.3
    visible[2] = False
    points[~visible] = 1e6
    found = normalize(Tracks.from_arrays(points, visible))
    assert (found.points[~visible] == 0).all()
    shown = [0, 1, 3, 4, 5]
    np.testing.assert_allclose(found.points[shown].sum(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(found.centroid[2], (found.centroid[1] + found.centroid[3]) / 2)


def test_one_extreme_outlier_does_not_change_the_unit() -> None:
    points = some_tracks()
    clean = normalize(Tracks.from_arrays(points))
    points[3, 4] = 1e9
    found = normalize(Tracks.from_arrays(points))
    assert 0.9 < found.unit / clean.unit < 1.1
    assert np.abs(found.points[3, 4]).min() > 1e5


def test_coincident_points_are_rejected() -> None:
    with pytest.raises(InvalidInput, match="points that differ") as caught:
        normalize(Tracks.from_arrays(np.full((3, 5, 2), 7.0)))
    assert caught.value.code == "no_extent"


def test_frames_that_mostly_show_one_point_have_the_extent_of_the_others() -> None:
    points = np.random.default_rng(0).normal(size=(9, 4, 2))
    visible = np.zeros((9, 4))
    visible[:7, 0] = 1  # each is its frame's median: the median radius is 0
    visible[7:] = 1
    found = normalize(Tracks.from_arrays(points, visible))
    np.testing.assert_allclose(
        found.unit, normalize(Tracks.from_arrays(np.concatenate([points[7:]] * 2))).unit * (8 / 15) ** 0.5
    )

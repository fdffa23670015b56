"""Fractional confidence is a weight: two halves equal one, and a very low one equals hidden."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Tracks, gallery, solve
from pliant.solver.evaluation import metrics
from pliant.solver.tracks.completion import coefficients_of, complete
from pliant.solver.tracks.noise import weighted_median
from pliant.solver.tracks.normalization import normalize

MADE = gallery.face(10, 60, degrees=60)
RNG = np.random.default_rng(5)
POINTS = np.array(MADE.tracks.points)
WRONG = RNG.random(POINTS.shape[:2]) < 0.05
SPOILED = np.where(WRONG[..., None], POINTS + 150.0, POINTS)
LITTLE, NOTHING = np.where(WRONG, 1e-6, 1.0), np.where(WRONG, 0.0, 1.0)


def test_duplicated_points_that_share_confidence_equal_single_points() -> None:
    share = RNG.uniform(0.1, 0.9, POINTS.shape[:2])
    once = normalize(Tracks.from_arrays(POINTS))
    twice = normalize(
        Tracks.from_arrays(np.concatenate([POINTS, POINTS], axis=1), np.concatenate([share, 1 - share], axis=1))
    )
    np.testing.assert_allclose(twice.centroid, once.centroid, rtol=1e-12)
    assert twice.unit == pytest.approx(once.unit, rel=1e-12)


def test_duplicated_frames_that_share_confidence_equal_single_frames() -> None:
    basis, points = RNG.normal(size=(10, 2, 4)), normalize(MADE.tracks).points
    weight, spread = RNG.uniform(0.2, 1.0, points.shape[:2]), np.diag([3.0, 2.0, 1.0])
    once, _ = coefficients_of(points, weight, basis, spread, 0.1, sweeps=1)
    part = RNG.uniform(0.1, 0.9, weight.shape)
    twice, _ = coefficients_of(
        np.concatenate([points, points]), np.concatenate([part * weight, (1 - part) * weight]),
        np.concatenate([basis, basis]), spread, 0.1, sweeps=1,
    )  # fmt: skip
    np.testing.assert_allclose(twice, once, rtol=2e-6, atol=1e-6)  # the ridge is relative to the mean frame


def test_a_value_of_weight_n_counts_n_times_in_the_median() -> None:
    values, counts = RNG.normal(size=31), RNG.integers(1, 5, size=31)
    repeated = np.sort(np.repeat(values, counts))
    assert weighted_median(values, counts.astype(float)) == repeated[(len(repeated) - 1) // 2]
    assert weighted_median(values, np.full(31, 0.3)) == np.median(values)


def test_completion_depends_only_on_the_ratios_of_confidences() -> None:
    weight = RNG.uniform(0.3, 1.0, POINTS.shape[:2])
    weight[0, 0] = 1.0
    full, half = (complete(normalize(Tracks.from_arrays(SPOILED, weight * factor))) for factor in (1.0, 0.5))
    np.testing.assert_allclose(half.gram, full.gram, rtol=1e-9, atol=1e-9)
    assert half.outlier_share == pytest.approx(full.outlier_share)


def test_completion_ignores_outliers_of_very_low_confidence() -> None:
    little, hidden, trusted = (
        complete(normalize(Tracks.from_arrays(SPOILED, visible))) for visible in (LITTLE, NOTHING, None)
    )
    assert trusted.outlier_share > 0.03
    assert little.outlier_share < 1e-5
    np.testing.assert_allclose(little.gram, hidden.gram, atol=3e-3 * np.abs(hidden.gram).max())


@pytest.mark.parametrize(
    "settings",
    [Settings(prior="smooth"), pytest.param(Settings(order="film"), marks=pytest.mark.slow)],
    ids=["smooth", "gaussian"],
)
def test_solve_ignores_outliers_of_very_low_confidence(settings: Settings) -> None:
    cameras = KnownCamera.from_arrays(MADE.rotations, MADE.scales)
    little, hidden = (
        solve(Tracks.from_arrays(SPOILED, visible), MADE.mesh, cameras=cameras, settings=settings)
        for visible in (LITTLE, NOTHING)
    )
    assert metrics.e3d_frame(little.shapes, hidden.shapes) < 0.01
    assert "outliers" not in little.choices.reasons

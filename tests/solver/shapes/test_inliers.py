"""Probability that an observation is an inlier: Bayes' rule, its invariances, and corrupted observations in a solve."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Tracks, gallery, solve
from pliant.solver.shapes.inliers import inlier_probability

RNG = np.random.default_rng(0)
LEFT = RNG.normal(size=(6, 50, 2))
SEEN = np.ones((6, 50))
NONE = np.zeros((6, 50), dtype=bool)
EXTENT = np.array([40.0, 30.0])


@pytest.mark.parametrize("loss", ["l1", "l2", "huber"])
def test_inlier_probability_follows_bayes_rule(loss: str) -> None:
    found = inlier_probability(LEFT, SEEN, NONE, noise_std=2.0, extent=EXTENT, loss=loss)
    share, area = 1 / 302, 42.0 * 32.0
    if loss == "l1":
        density = np.exp(-np.sqrt(2) * np.abs(LEFT).sum(axis=2) / 2) / (2 * 4)
    else:
        density = np.exp(-np.square(LEFT).sum(axis=2) / 8) / (2 * np.pi * 4)
    np.testing.assert_allclose(found, (1 - share) * density / ((1 - share) * density + share / area), rtol=1e-12)


@pytest.mark.parametrize("loss", ["l1", "l2"])
def test_probability_is_unit_free_and_decreases_with_the_residual(loss: str) -> None:
    one = inlier_probability(LEFT, SEEN, NONE, noise_std=2.0, extent=EXTENT, loss=loss)
    scaled = inlier_probability(1e3 * LEFT, SEEN, NONE, noise_std=2e3, extent=1e3 * EXTENT, loss=loss)
    np.testing.assert_allclose(one, scaled, rtol=1e-9)
    longer = inlier_probability(3 * LEFT, SEEN, NONE, noise_std=9.0, extent=EXTENT, loss=loss)
    assert (longer < inlier_probability(LEFT, SEEN, NONE, noise_std=9.0, extent=EXTENT, loss=loss)).all()


def test_lower_confidence_acts_as_larger_noise() -> None:
    """With the loss `l2` an observation of confidence v has the noise variance σ²/v."""
    half = inlier_probability(LEFT, 0.5 * SEEN, NONE, noise_std=3.0, extent=1e9 * EXTENT, loss="l2")
    wide = inlier_probability(LEFT, SEEN, NONE, noise_std=3.0 * 2**0.5, extent=1e9 * EXTENT, loss="l2")
    np.testing.assert_allclose(half, wide, rtol=1e-6)


def test_rejected_is_zero_and_hidden_is_nan() -> None:
    seen, rejected = SEEN.copy(), NONE.copy()
    seen[0, :5], rejected[1, :3] = 0, True
    found = inlier_probability(LEFT, seen, rejected, noise_std=2.0, extent=EXTENT, loss="l1")
    assert np.isnan(found[seen == 0]).all()
    assert (found[rejected] == 0).all()
    assert (found[(seen > 0) & ~rejected] > 0).all()
    far = inlier_probability(1e3 * LEFT, SEEN, NONE, noise_std=1e-3, extent=EXTENT, loss="l2")
    assert (far > 0).all(), "0 means rejected"
    nothing = inlier_probability(LEFT, SEEN, ~NONE, noise_std=2.0, extent=EXTENT, loss="l1")
    assert (nothing == 0).all()


@pytest.mark.parametrize("settings", [Settings(), Settings(prior="smooth")], ids=["gaussian", "smooth"])
def test_corrupted_observations_are_improbable_and_clean_ones_probable(settings: Settings) -> None:
    made = gallery.face(12, 100, degrees=60)
    tracks = gallery.corrupt(made, outliers=0.05, noise=0.003, seed=2).tracks
    visible = np.ones(tracks.visible.shape)
    visible[3, :10] = 0
    found = solve(
        Tracks.from_arrays(tracks.points, visible), made.mesh,
        cameras=KnownCamera.from_arrays(made.rotations, made.scales), settings=settings,
    )  # fmt: skip
    moved = np.linalg.norm(tracks.points - made.tracks.points, axis=2)
    gross, clean = (
        (moved > 0.5 * found.choices.unit) & (visible > 0),
        (moved < 0.05 * found.choices.unit) & (visible > 0),
    )
    probability = found.inlier_probability
    assert probability is not None
    assert not probability.flags.writeable
    assert (probability[gross] < 0.5).mean() > 0.95
    assert (probability[clean] > 0.5).mean() > 0.98
    assert np.isnan(probability[visible == 0]).all()

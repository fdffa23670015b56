"""Rejection of gross outliers: the corrupted observations are rejected and reported, clean ones are kept."""

from __future__ import annotations

import re

import numpy as np
import pytest
from pliant.solver import (
    KnownCamera,
    Outcome,
    Settings,
    Tracks,
    estimate_cameras,
    find_outliers,
    gallery,
    learn_prior,
    solve,
)
from pliant.solver.evaluation import metrics
from pliant.solver.shapes import outlier_rejection

MADE = gallery.face(24, 300, degrees=60)
CAMERAS = KnownCamera.from_arrays(MADE.rotations, MADE.scales)
OUTLIER_SHARE = gallery.corrupt(MADE, outliers=0.1, seed=4).tracks
WRONG = np.abs(np.asarray(OUTLIER_SHARE.points) - np.asarray(MADE.tracks.points)).max(axis=2) > 0


@pytest.mark.parametrize(
    "cameras", [pytest.param(CAMERAS, id="known"), pytest.param(None, id="estimated", marks=pytest.mark.long)]
)
@pytest.mark.slow
def test_rejected_observations_are_the_corrupted_ones(cameras: KnownCamera | None) -> None:
    found = solve(OUTLIER_SHARE, cameras=cameras)
    left_out = found.weights == 0
    size = np.abs(np.asarray(MADE.tracks.points)).max()
    gross = np.linalg.norm(np.asarray(OUTLIER_SHARE.points) - np.asarray(MADE.tracks.points), axis=2) > 0.3 * size
    assert left_out[gross].mean() > 0.97
    assert left_out[~WRONG].mean() < 0.03
    share = re.match(r"([\d.]+)% of the visible observations", found.choices.reasons["outliers"])
    assert share is not None
    assert float(share.group(1)) == pytest.approx(100 * left_out.mean(), abs=0.06)


@pytest.mark.parametrize("cameras", [CAMERAS, None], ids=["known", "estimated"])
@pytest.mark.slow
@pytest.mark.long
def test_rejection_equals_hiding_the_outliers(cameras: KnownCamera | None) -> None:
    found = solve(OUTLIER_SHARE, cameras=cameras)
    hidden = solve(Tracks.from_arrays(OUTLIER_SHARE.points, found.weights > 0), cameras=cameras)
    error, least = (metrics.e3d_frame(each.shapes, MADE.shapes) for each in (found, hidden))
    assert error < 1.1 * least + 1e-3
    assert "outliers" not in hidden.choices.reasons
    far = np.linalg.norm(np.asarray(OUTLIER_SHARE.points) - np.asarray(MADE.tracks.points), axis=2) > found.choices.unit
    assert (found.residuals[far] > 0.5 * found.choices.unit).all(), "they are reported all the same"


def test_clean_tracks_and_the_published_prior_reject_nothing() -> None:
    clean = solve(MADE.tracks, cameras=CAMERAS)
    assert "outliers" not in clean.choices.reasons
    assert (clean.weights > 0).all()
    published = solve(OUTLIER_SHARE, cameras=CAMERAS, settings=Settings(prior="smooth"))
    assert "outliers" not in published.choices.reasons
    assert (published.weights > 0).all()


@pytest.mark.slow
@pytest.mark.long
def test_outliers_of_a_nearly_rigid_body_are_found() -> None:
    rigid = gallery.face(40, 200, degrees=60)
    still = rigid.shapes.mean(axis=0) + 0.02 * (rigid.shapes - rigid.shapes.mean(axis=0))
    points = np.einsum("fij,fpj->fpi", rigid.rotations[:, :2], still)
    random = np.random.default_rng(2)
    wrong = random.random(points.shape[:2]) < 0.1
    points[wrong] = random.uniform(points.min(), points.max(), (int(wrong.sum()), 2))
    found = solve(Tracks.from_arrays(points), rigid.mesh)
    assert (found.weights[wrong] == 0).mean() > 0.95
    assert (found.weights[~wrong] == 0).mean() < 0.03
    assert metrics.e3d_frame(found.shapes, still) < 0.02


@pytest.mark.slow
def test_a_prior_of_weight_zero_rejects_nothing() -> None:
    found = solve(OUTLIER_SHARE, cameras=CAMERAS, settings=Settings(temporal_weight=0))
    assert np.isfinite(found.shapes).all()
    assert found.choices.temporal_weight == 0
    assert np.median(found.residuals) < 1e-6 * found.choices.unit, "every track can be followed"
    assert (np.diff(found.trace.objective) <= 0).all()
    assert metrics.e3d_frame(found.shapes, MADE.shapes) > 0.3, "and nothing says how deep it is"


def test_a_stop_before_the_shapes_rejects_nothing() -> None:
    found = solve(OUTLIER_SHARE, cameras=CAMERAS, should_stop=lambda: True)
    assert found.outcome is Outcome.STOPPED
    assert (found.weights > 0).all()


@pytest.mark.slow
def test_long_films_are_judged_in_windows_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Distant frames hardly change a prediction, so windows suffice for long films."""
    cameras = estimate_cameras(OUTLIER_SHARE, CAMERAS, settings=Settings(order="film"))
    prior = learn_prior(OUTLIER_SHARE, cameras)
    whole = find_outliers(OUTLIER_SHARE, cameras, prior)
    monkeypatch.setattr(outlier_rejection, "LEARNED_FRAMES", 12)
    monkeypatch.setattr(outlier_rejection, "POINTS_PER_CHUNK", 100)
    parts = find_outliers(OUTLIER_SHARE, cameras, prior)
    gross = np.linalg.norm(np.asarray(OUTLIER_SHARE.points) - np.asarray(MADE.tracks.points), axis=2) > 0.3 * prior.unit
    assert whole[gross].mean() > 0.97
    assert parts[gross].mean() > 0.95
    assert whole[~WRONG].mean() < 0.01
    assert parts[~WRONG].mean() < 0.01

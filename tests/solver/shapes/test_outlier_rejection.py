"""Rejection of gross outliers: the corrupted observations are rejected and reported, clean ones are kept."""

from __future__ import annotations

import re

import numpy as np
import pytest
from pliant.solver import KnownCamera, Outcome, Settings, Tracks, gallery, solve
from pliant.solver.evaluation import metrics

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


@pytest.mark.slow
@pytest.mark.long
def test_starting_again_without_the_outliers_does_not_lose_accuracy(monkeypatch: pytest.MonkeyPatch) -> None:
    """On average of three draws: one draw moves by a fifth either way."""
    again, once = [], []
    for seed in (4, 5, 6):
        tracks = gallery.corrupt(MADE, outliers=0.1, seed=seed).tracks
        again.append(metrics.e3d_frame(solve(tracks).shapes, MADE.shapes))
        with monkeypatch.context() as patch:
            patch.setattr("pliant.solver.reconstruction.start.MIN_POINTS", 10_000)  # too few points would be left
            found = solve(tracks)
        assert (found.weights == 0).mean() == pytest.approx(0.1, abs=0.03)
        once.append(metrics.e3d_frame(found.shapes, MADE.shapes))
    assert np.mean(once) > np.mean(again) - 1e-3


def test_clean_tracks_and_the_published_prior_reject_nothing() -> None:
    clean = solve(MADE.tracks, cameras=CAMERAS)
    assert "outliers" not in clean.choices.reasons
    assert (clean.weights > 0).all()
    published = solve(OUTLIER_SHARE, cameras=CAMERAS, settings=Settings(prior="smooth"))
    assert "outliers" not in published.choices.reasons
    assert (published.weights > 0).all()


@pytest.mark.slow
@pytest.mark.long
def test_the_stiff_fit_descends_though_the_learned_paths_hardly_move() -> None:
    """A nearly rigid body: the prior's precision spans ten magnitudes, and 300 times that in the stiff fit."""
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


def test_a_prior_of_weight_zero_rejects_nothing() -> None:
    found = solve(OUTLIER_SHARE, cameras=CAMERAS, settings=Settings(temporal_weight=0))
    assert np.isfinite(found.shapes).all()
    assert found.choices.temporal_weight == 0
    assert np.median(found.residuals) < 1e-6 * found.choices.unit, "every track can be followed"
    assert (np.diff(found.trace.objective) <= 0).all()
    assert metrics.e3d_frame(found.shapes, MADE.shapes) > 0.3, "and nothing says how deep it is"


def test_a_stop_before_the_stiff_fit_rejects_nothing() -> None:
    found = solve(OUTLIER_SHARE, cameras=CAMERAS, should_stop=lambda: True)
    assert found.outcome is Outcome.STOPPED
    assert (found.weights > 0).all()

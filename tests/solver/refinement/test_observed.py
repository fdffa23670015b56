"""Cameras and covariance from the observations themselves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Tracks, estimate_cameras, gallery
from pliant.solver.cameras.estimation import CameraEstimate, given_cameras
from pliant.solver.cameras.perspective import Perspective
from pliant.solver.model.expectation_maximisation import MAX_MODES
from pliant.solver.reconstruction import cameras as reconstruction
from pliant.solver.records import Floats
from pliant.solver.refinement.joint_refinement import refine_cameras
from pliant.solver.refinement.learned import Refinement
from pliant.solver.refinement.observed import Moments, Observed, cross_fitted, on_observations
from pliant.solver.tracks.normalization import Normalized, normalize

MADE = gallery.face(20, 60, degrees=60)
KNOWN = KnownCamera.from_arrays(MADE.rotations, MADE.scales)
USED = np.arange(20)
ONES = np.ones(20)
KEPT = Refinement(turning=False)
KAPPA = 0.1


def begun(tracks: Tracks) -> tuple[Observed, object, Moments]:
    normalized = normalize(tracks)
    estimate = given_cameras(normalized, KNOWN, Settings())
    observed = Observed.of(normalized, estimate, USED)
    completed = Moments(estimate.gram, estimate.sample, np.asarray(estimate.translations), estimate.outlier_share)
    return observed, estimate, completed


def true_sample(unit: float) -> Floats:
    points = np.asarray(MADE.tracks.points)
    return np.asarray((points - points.mean(axis=1, keepdims=True)) / unit)


def test_a_point_is_judged_by_a_covariance_of_the_others() -> None:
    """A point that jumps about would get its own modes if it were learned from; the others do not predict it."""
    points = np.array(MADE.tracks.points)
    random = np.random.default_rng(0)
    wild = random.random(20) < 0.6
    points[wild, 7] = random.uniform(points.min(), points.max(), (wild.sum(), 2))
    visible = random.random(points.shape[:2]) > 0.05
    visible[:, 7] = True
    observed, estimate, _ = begun(Tracks.from_arrays(points, visible))
    probability, share = cross_fitted(observed, estimate, USED, seed=0)  # type: ignore[arg-type]
    apart = np.linalg.norm(points - MADE.tracks.points, axis=2) > 0.2 * normalize(MADE.tracks).unit
    assert (probability[apart] < 0.5).mean() > 0.8
    others = np.delete(np.where(observed.confidence > 0, probability, 1.0), 7, axis=1)
    assert (others < 0.5).mean() < 0.01
    assert share < 0.03


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_expected_moments_are_nearer_to_the_truth_than_completed_tracks(outliers: float) -> None:
    tracks = gallery.corrupt(MADE, noise=0.005, hidden=0.4, outliers=outliers, seed=3).tracks
    observed, _, completed = begun(tracks)
    start = KEPT.learn(completed.gram, np.asarray(KNOWN.rotations), ONES)
    found, moments, _ = on_observations(observed, start, completed, ONES, KEPT)
    np.testing.assert_array_equal(found.rotations, KNOWN.rotations)
    true = true_sample(normalize(tracks).unit)
    hidden = observed.confidence == 0
    error, before = (np.linalg.norm((each.sample - true)[hidden]) for each in (moments, completed))
    assert error < before
    flat = true.transpose(0, 2, 1).reshape(40, -1)
    gram = flat @ flat.T / flat.shape[1]
    assert np.linalg.norm(moments.gram - gram) < np.linalg.norm(completed.gram - gram)
    assert moments.outlier_share == pytest.approx(outliers, abs=0.012)


def seen_by_a_pinhole(observed: Observed, tracks: Tracks, **view: float) -> Observed:
    """Return the observations with the perspective of κ = `KAPPA` and, unless `view` says otherwise, the same κ to start from."""
    depths = np.einsum("fj,fpj->fp", MADE.rotations[:, 2], MADE.shapes) / normalize(tracks).unit
    depths -= depths.mean(axis=1, keepdims=True)
    bent = observed.points / (1 + KAPPA * depths)[..., None]
    found = Perspective(np.zeros((20, 2)), np.zeros(2), **{"inverse_focal": KAPPA, **view})  # type: ignore[arg-type]
    return replace(observed, points=bent, view=found)


def test_perspective_is_corrected_with_the_depths_of_the_expected_tracks() -> None:
    """Tracks of a pinhole give the moments that the same tracks give under orthography."""
    tracks = gallery.corrupt(MADE, hidden=0.2, seed=2).tracks
    observed, _, completed = begun(tracks)
    start = KEPT.learn(completed.gram, np.asarray(KNOWN.rotations), ONES)
    _, flat, _ = on_observations(observed, start, completed, ONES, KEPT)
    pinhole = seen_by_a_pinhole(observed, tracks, given=KAPPA)
    _, moments, _ = on_observations(pinhole, start, completed, ONES, KEPT)
    uncorrected = replace(pinhole, view=None)
    _, wrong, _ = on_observations(uncorrected, start, completed, ONES, KEPT)
    error, least = (np.linalg.norm(each.sample - flat.sample) for each in (wrong, moments))
    assert least < 0.25 * error


@pytest.mark.parametrize("confidence", [0.0, 0.3])
def test_the_focal_length_follows_the_observations_and_not_their_orthographic_completion(confidence: float) -> None:
    """A κ that is too small, as completed tracks make it, becomes the true one where 40 % of the entries are hidden or uncertain."""
    random = np.random.default_rng(4)
    visible = np.where(random.random(MADE.tracks.points.shape[:2]) < 0.4, confidence, 1.0)
    tracks = Tracks.from_arrays(MADE.tracks.points, visible)
    observed, _, completed = begun(tracks)
    start = KEPT.learn(completed.gram, np.asarray(KNOWN.rotations), ONES)
    free = seen_by_a_pinhole(observed, tracks, inverse_focal=0.6 * KAPPA)
    _, _, found = on_observations(free, start, completed, ONES, KEPT)
    assert found is not None
    assert found.inverse_focal == pytest.approx(KAPPA, rel=0.1)
    given = seen_by_a_pinhole(observed, tracks, given=0.6 * KAPPA, inverse_focal=0.6 * KAPPA)
    _, _, kept = on_observations(given, start, completed, ONES, KEPT)
    assert kept is not None
    assert kept.inverse_focal == 0.6 * KAPPA


def test_a_stop_leaves_the_cameras() -> None:
    tracks = gallery.corrupt(MADE, hidden=0.2, seed=2).tracks
    observed, _, completed = begun(tracks)
    start = KEPT.learn(completed.gram, np.asarray(KNOWN.rotations), ONES)
    found, moments, _ = on_observations(observed, start, completed, ONES, Refinement(should_stop=lambda: True))
    assert found is start
    assert np.isfinite(moments.gram).all()


@pytest.mark.parametrize("turning", [True, False])
def test_cameras_are_refined_on_the_observations_where_entries_are_hidden(turning: bool) -> None:
    """Completed tracks of noisy points support few modes; the moments, which include their uncertainty, support all."""
    tracks = gallery.corrupt(MADE, noise=0.01, hidden=0.3, seed=2).tracks
    normalized = normalize(tracks)
    estimate = given_cameras(normalized, KNOWN, Settings())
    found, data = refine_cameras(estimate, normalized, np.ones(20, dtype=bool), turning=turning)
    assert np.abs(data.gram - estimate.gram).max() > 1e-5
    assert np.abs(data.sample - estimate.sample)[normalized.visible == 0].max() > 1e-3
    assert np.abs(np.asarray(found.translations) - estimate.translations).max() > 1e-5
    assert (data.model_order.max_modes == MAX_MODES) == turning
    assert np.array_equal(found.rotations, estimate.rotations) != turning


def test_outliers_are_kept_if_too_few_points_would_remain(monkeypatch: pytest.MonkeyPatch) -> None:
    tracks = gallery.corrupt(MADE, outliers=0.1, seed=1).tracks
    nothing = np.zeros(tracks.visible.shape)
    monkeypatch.setattr(reconstruction, "cross_fitted", lambda *_, **__: (nothing, 0.5))
    found = estimate_cameras(tracks, KNOWN)
    assert np.array_equal(found.observations.normalized.points, normalize(tracks).points)
    assert 0.05 < found.outlier_share < 0.15


def test_outliers_are_hidden_from_the_refinement_and_left_to_the_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Completion would follow some of them again, and so would the correction for perspective."""
    made = gallery.corrupt(MADE, outliers=0.1, seed=1)
    given, refine = [], reconstruction.refine_cameras

    def spied(estimate: CameraEstimate, normalized: Normalized, *others: Any, **how: Any) -> object:
        given.append(normalized)
        return refine(estimate, normalized, *others, **how)

    monkeypatch.setattr(reconstruction, "refine_cameras", spied)
    found = estimate_cameras(made.tracks, KNOWN)
    wrong = made.outliers & (
        np.linalg.norm(made.tracks.points - MADE.tracks.points, axis=2) > 0.1 * normalize(MADE.tracks).unit
    )
    assert (given[0].visible[wrong] == 0).mean() > 0.98
    assert (given[0].visible[~made.outliers] > 0).mean() > 0.98
    assert (found.observations.normalized.visible == made.tracks.visible).all()


@pytest.mark.slow
def test_outliers_do_not_affect_the_unit_of_the_tracks() -> None:
    points, random = np.array(MADE.tracks.points), np.random.default_rng(1)
    wrong = random.random(points.shape[:2]) < 0.1
    points[wrong] += random.uniform(-400, 400, (wrong.sum(), 2))
    tracks = Tracks.from_arrays(points)
    found = estimate_cameras(tracks, KNOWN)
    clean = normalize(MADE.tracks).unit
    assert normalize(tracks).unit > 1.05 * clean
    assert found.observations.normalized.unit == pytest.approx(clean, rel=0.02)
    assert found.outlier_share == pytest.approx(wrong.mean(), abs=0.015)
    assert (found.observations.normalized.visible == tracks.visible).all()

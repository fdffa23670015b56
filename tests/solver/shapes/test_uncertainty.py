"""Posterior standard deviations: the information form, draws from the prior, and what hiding and noise do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pliant.solver.gallery import face
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.records import Camera
from pliant.solver.shapes import uncertainty
from pliant.solver.shapes.uncertainty import Pinhole, bounded_by_neighbours, position_std
from scipy.spatial.transform import Rotation

FRAMES = 9
NOISE = 0.02


def covariance(seed: int = 0, frames: int = FRAMES) -> ShapeCovariance:
    rng = np.random.default_rng(seed)
    spread = rng.normal(size=(3, 3))
    axis_covariance = spread @ spread.T + np.eye(3)
    modes = 0.2 * np.cumsum(rng.normal(size=(frames, 2)), axis=0) / np.sqrt(frames)
    return ShapeCovariance(
        np.diag([1.0, 0.8, 0.4]), axis_covariance * 3 / np.trace(axis_covariance), modes, 1e-3, NOISE**2, np.inf
    )


def projections(frames: int = FRAMES, degrees: float = 40) -> np.ndarray:
    angles = np.linspace(-degrees, degrees, frames)
    return np.asarray(Rotation.from_euler("y", angles[:, None], degrees=True).as_matrix()[:, :2])


def dense(given: ShapeCovariance) -> np.ndarray:
    ones = np.ones((len(given.modes), len(given.modes)))
    return np.kron(ones, given.mean_covariance) + np.kron(given.over_frames(), given.axis_covariance)


def projection_matrix(pairs: np.ndarray) -> np.ndarray:
    frames = len(pairs)
    matrix = np.zeros((2 * frames, 3 * frames))
    for f, pair in enumerate(pairs):
        matrix[2 * f : 2 * f + 2, 3 * f : 3 * f + 3] = pair
    return matrix


def test_position_std_comes_from_the_inverse_posterior_precision() -> None:
    given, pairs = covariance(), projections()
    rng = np.random.default_rng(1)
    confidence = rng.choice([0.0, 0.5, 1.0], size=(FRAMES, 6))
    found = position_std(given, pairs, confidence, noise_std=NOISE)
    matrix, prior = projection_matrix(pairs), dense(given)
    for point in range(6):
        weights = np.repeat(confidence[:, point], 2) / NOISE**2
        posterior = np.linalg.inv(np.linalg.inv(prior) + matrix.T @ (weights[:, None] * matrix))
        expected = np.sqrt(np.diag(posterior).reshape(FRAMES, 3).sum(axis=1))
        np.testing.assert_allclose(found[:, point], expected, rtol=1e-5)


def seen_by_a_pinhole(*, y_up: bool, frames: int = FRAMES, points: int = 5) -> tuple[Camera, np.ndarray]:
    """A camera that turns by 80°, and shapes 3 half-sizes away from it."""
    turns = np.concatenate([projections(frames), np.zeros((frames, 1, 3))], axis=1)
    turns[:, 2] = np.cross(turns[:, 0], turns[:, 1])
    random = np.random.default_rng(6)
    camera = Camera(
        turns, random.uniform(0.9, 1.1, frames), random.normal(300, 5, (frames, 2)), 480.0, 1.0, np.array([310.0, 290.0]), y_up
    )  # fmt: skip
    return camera, 80.0 * random.normal(size=(frames, points, 3)).clip(-2, 2)


@pytest.mark.parametrize("y_up", [False, True])
def test_position_std_under_perspective_uses_the_projection_derivative(y_up: bool) -> None:
    camera, shapes = seen_by_a_pinhole(y_up=y_up)
    unit, given = 80.0, covariance()
    pairs = camera.scales[:, None, None] * camera.rotations[:, :2]
    confidence = np.random.default_rng(1).choice([0.0, 0.5, 1.0], size=(FRAMES, 5))
    found = position_std(given, pairs, confidence, noise_std=NOISE, pinhole=Pinhole.of(camera, shapes, unit))
    ahead, back = (
        [camera.project(shapes + sign * 1e-4 * np.eye(3)[axis]) for axis in range(3)] for sign in (1, -1)
    )  # fmt: skip
    slopes = np.stack([(a - b) / 2e-4 for a, b in zip(ahead, back, strict=True)], axis=-1)
    for point in range(5):
        matrix = projection_matrix(slopes[:, point])
        weights = np.repeat(confidence[:, point], 2) / NOISE**2
        posterior = np.linalg.inv(np.linalg.inv(dense(given)) + matrix.T @ (weights[:, None] * matrix))
        expected = np.sqrt(np.diag(posterior).reshape(FRAMES, 3).sum(axis=1))
        np.testing.assert_allclose(found[:, point], expected, rtol=1e-4)
    flat = position_std(given, pairs, confidence, noise_std=NOISE)
    assert np.abs(np.log(found / flat)).max() > 0.05, "perspective changes what the images determine"


def test_a_few_representatives_stand_for_the_derivatives_of_all_points(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = face(12, 150)
    unit = float(np.abs(sequence.shapes).max()) / 2
    camera, _ = seen_by_a_pinhole(y_up=False, frames=12)
    shapes = 80.0 * sequence.shapes / unit
    pairs = camera.scales[:, None, None] * camera.rotations[:, :2]
    given, seen = covariance(5, 12), np.ones(shapes.shape[:2])
    pinhole = Pinhole.of(camera, shapes, 80.0)
    few = position_std(given, pairs, seen, noise_std=NOISE, pinhole=pinhole)
    monkeypatch.setattr(uncertainty, "REPRESENTATIVES", shapes.shape[1])
    exact = position_std(given, pairs, seen, noise_std=NOISE, pinhole=pinhole)
    assert np.ptp(exact, axis=1).max() > 0
    assert np.median(np.abs(np.log(few / exact))) < 0.04
    assert np.median(np.abs(np.log(position_std(given, pairs, seen, noise_std=NOISE) / exact))) > 0.1


def test_errors_of_the_posterior_mean_are_as_large_as_stated() -> None:
    given, pairs, count = covariance(), projections(), 4000
    rng = np.random.default_rng(2)
    prior, matrix = dense(given), projection_matrix(pairs)
    paths = np.linalg.cholesky(prior) @ rng.normal(size=(3 * FRAMES, count))
    images = matrix @ paths + NOISE * rng.normal(size=(2 * FRAMES, count))
    image = matrix @ prior @ matrix.T + NOISE**2 * np.eye(2 * FRAMES)
    errors = (prior @ matrix.T @ np.linalg.solve(image, images) - paths).reshape(FRAMES, 3, count)
    measured = np.sqrt((errors**2).sum(axis=1).mean(axis=1))
    stated = position_std(given, pairs, np.ones((FRAMES, 1)), noise_std=NOISE)[:, 0]
    np.testing.assert_allclose(measured, stated, rtol=0.05)


def test_equal_visibility_gives_equal_deviation_and_hiding_or_noise_increases_it() -> None:
    given, pairs = covariance(), projections()
    clear = position_std(given, pairs, np.ones((FRAMES, 3)), noise_std=NOISE)
    assert np.ptp(clear, axis=1).max() == 0
    hidden = np.ones((FRAMES, 3))
    hidden[4:7, 1] = 0
    partly = position_std(given, pairs, hidden, noise_std=NOISE)
    assert (partly[:, 1] >= clear[:, 1] - 1e-12).all()
    assert (partly[4:7, 1] > 1.2 * clear[4:7, 1]).all()
    assert (position_std(given, pairs, np.ones((FRAMES, 3)), noise_std=3 * NOISE) > clear).all()


def test_unseen_points_have_the_prior_std_and_less_rotation_increases_it() -> None:
    given = covariance()
    never = position_std(given, projections(), np.zeros((FRAMES, 1)), noise_std=NOISE)[:, 0]
    np.testing.assert_allclose(never**2, np.diag(dense(given)).reshape(FRAMES, 3).sum(axis=1))
    seen = np.ones((FRAMES, 1))
    wide, narrow = (position_std(given, projections(degrees=turn), seen, noise_std=NOISE) for turn in (40, 4))
    assert (narrow > wide).all()


def test_std_predicted_from_sampled_patterns_is_close_to_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, points = 24, 150
    given, pairs = covariance(3, frames), projections(frames)
    rng = np.random.default_rng(4)
    centre, width = rng.uniform(0, frames, points), rng.uniform(2, 8, points)
    confidence = (np.abs(np.arange(frames)[:, None] - centre) > width).astype(float)
    monkeypatch.setattr(uncertainty, "MAX_PATTERNS", points)
    exact = position_std(given, pairs, confidence, noise_std=NOISE)
    monkeypatch.setattr(uncertainty, "MAX_PATTERNS", 40)
    predicted = position_std(given, pairs, confidence, noise_std=NOISE)
    assert np.array_equal(predicted, position_std(given, pairs, confidence, noise_std=NOISE)), "it is deterministic"
    assert not np.array_equal(predicted, exact)
    assert np.median(np.abs(np.log(predicted / exact))) < 0.1


@pytest.mark.parametrize("confidence", [1.0, 0.3])
def test_points_with_short_tracks_get_the_std_of_similar_tracks(
    monkeypatch: pytest.MonkeyPatch, confidence: float
) -> None:
    frames, points = 24, 400
    given, pairs = covariance(3, frames), projections(frames)
    first, last = np.sort(np.random.default_rng(4).integers(0, frames, (points, 2)), axis=1).T
    shown = (np.arange(frames)[:, None] >= first) & (np.arange(frames)[:, None] <= last)
    weights = np.where(np.arange(points) % 2 == 0, 1.0, confidence) * shown
    exact = position_std(given, pairs, weights, noise_std=NOISE)
    monkeypatch.setattr(uncertainty, "MAX_PATTERNS", 100)
    off = np.log(position_std(given, pairs, weights, noise_std=NOISE) / exact)
    assert np.sqrt(np.mean(off**2)) < 0.2
    assert abs(off[shown].mean()) < 0.05


def test_variances_that_vanish_by_rounding_predict_finite_ones() -> None:
    weights = np.triu(np.ones((5, 5)))
    everything = np.full((5, 5), 1e-18)
    everything[:, 2:] = 0.0
    exact = np.array([[1e-18, -1e-19], [0.0, 2e-18], [1e-17, 1.0], [-1e-30, 0.0], [3e-18, 1e-18]])
    found = uncertainty._predicted(everything, weights, np.array([0, 1]), exact)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found[:, :2], exact)
    assert (found[:, 2:] >= 0).all()


def test_points_visible_in_all_frames_or_in_none_have_the_exact_std_beside_rarely_visible_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given, pairs = covariance(), projections()
    confidence = np.ones((FRAMES, 60))
    confidence[:, 20:40], confidence[2:, 40:] = 0.0, 0.0
    confidence[1, 40::2] = 0.0
    monkeypatch.setattr(uncertainty, "MAX_PATTERNS", 8)
    found = position_std(given, pairs, confidence, noise_std=NOISE)
    always, never = (position_std(given, pairs, np.full((FRAMES, 1), each), noise_std=NOISE) for each in (1.0, 0.0))
    np.testing.assert_allclose(found[:, :20], np.repeat(always, 20, axis=1), rtol=1e-12)
    np.testing.assert_allclose(found[:, 20:40], np.repeat(never, 20, axis=1), rtol=1e-12)


def test_evaluating_some_frames_of_a_long_film_rarely_understates_the_std(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = 30
    given, pairs, seen = covariance(5, frames), projections(frames), np.ones((frames, 2))
    exact = position_std(given, pairs, seen, noise_std=NOISE)
    monkeypatch.setattr(uncertainty, "MAX_POSTERIOR_FRAMES", 10)
    fewer = position_std(given, pairs, seen, noise_std=NOISE)
    assert fewer.shape == exact.shape
    assert (fewer > 0.99 * exact).mean() > 0.95


def test_std_of_sparse_points_is_bounded_by_their_distance_from_the_surface() -> None:
    shapes = np.zeros((4, 3, 3))
    shapes[:, 1, 0], shapes[:, 2, 0] = 0.1, 5.0
    visible = np.array([[1.0, 0.0, 1.0]] * 4)
    std = np.array([[0.03, 2.0, 0.04]] * 4)
    bounded = bounded_by_neighbours(std, shapes, visible)
    np.testing.assert_allclose(bounded[:, 1], np.hypot(0.03, 0.1))
    assert np.array_equal(bounded[:, [0, 2]], std[:, [0, 2]])
    assert bounded_by_neighbours(std, shapes, np.ones((4, 3))) is std
    assert bounded_by_neighbours(std, shapes, np.zeros((4, 3))) is std


def test_noise_below_the_rounding_of_a_huge_covariance_gives_finite_deviations() -> None:
    """As with wrong given rotations, where the shapes are many radii deep."""
    given = covariance()
    huge = replace(given, mean_covariance=1e12 * given.mean_covariance)
    found = position_std(huge, projections(degrees=1e-3), np.ones((FRAMES, 2)), noise_std=1e-4)
    assert np.isfinite(found).all()
    assert (found > 0).all()

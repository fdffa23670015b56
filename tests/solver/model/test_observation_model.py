"""The robust observation model against the formulas for one point at a time, with dense matrices."""

from __future__ import annotations

import os

import numpy as np
import pytest
from numpy.typing import NDArray
from pliant.solver.model import observation_model
from pliant.solver.model.observation_model import CERTAIN, SHARE_BOUNDS, ImageDensity, inlier_probabilities
from pliant.solver.records import Floats
from pliant.solver.threads import threads_limited

FRAMES, POINTS, NOISE = 7, 30, 0.01


def paths(seed: int = 0) -> tuple[Floats, Floats]:
    """Return S `(2F, 2F)` and tracks `(F, P, 2)` with this density."""
    random = np.random.default_rng(seed)
    roots = random.normal(size=(2 * FRAMES, 5))
    covariance = roots @ roots.T + NOISE * np.eye(2 * FRAMES)
    columns = np.linalg.cholesky(covariance) @ random.normal(size=(2 * FRAMES, POINTS))
    return covariance, columns.reshape(FRAMES, 2, POINTS).transpose(0, 2, 1)


def partly_seen(seed: int = 1) -> tuple[Floats, Floats]:
    """Return confidences, 0 for a fifth, and weights below them for another fifth, `(F, P)`."""
    random = np.random.default_rng(seed)
    confidence = (random.random((FRAMES, POINTS)) < 0.8) * np.where(random.random((FRAMES, POINTS)) < 0.2, 0.5, 1.0)
    confidence[:, 0] = 1.0
    weight = confidence * np.where(random.random((FRAMES, POINTS)) < 0.2, random.uniform(0.01, 0.9), 1.0)
    weight[:, 0] = 1.0
    return np.asarray(confidence, dtype=float), np.asarray(weight, dtype=float)


def noise_of(weight: Floats) -> Floats:
    """Return the noise beyond σ² of the coordinates of one point, `(2n,)`."""
    return np.repeat(NOISE * (1 / weight - 1), 2)


def rows_of(frames: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.stack([2 * frames, 2 * frames + 1], axis=1).ravel()


def test_expected_tracks_are_the_conditional_moments() -> None:
    covariance, points = paths()
    _, weight = partly_seen()
    points = np.where(weight[..., None] > 0, points, 0.0)
    means, total = ImageDensity.of(covariance, NOISE).moments(points, weight)
    expected = np.zeros_like(total)
    for point in range(POINTS):
        seen = np.flatnonzero(weight[:, point] > 0)
        rows = rows_of(seen)
        observed = covariance[np.ix_(rows, rows)] + np.diag(noise_of(weight[seen, point]))
        gain = np.linalg.solve(observed, covariance[rows]).T
        np.testing.assert_allclose(means[:, point], gain @ points[seen, point].ravel(), atol=1e-9)
        expected += covariance - gain @ covariance[rows]
    np.testing.assert_allclose(total, expected, atol=1e-9)


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(4)), raising=False)
    monkeypatch.setattr(observation_model, "SMALLEST", 1)
    covariance, points = paths()
    confidence, weight = partly_seen()
    points = np.where(weight[..., None] > 0, points, 0.0)
    density, results = ImageDensity.of(covariance, NOISE), []
    for threads in (1, 4):
        with threads_limited(threads):
            results.append((*density.moments(points, weight), *density.left_out(points, confidence, weight)))
    for alone, together in zip(*results, strict=True):
        np.testing.assert_array_equal(together, alone)


def test_complete_tracks_are_their_own_expectation() -> None:
    covariance, points = paths()
    means, total = ImageDensity.of(covariance, NOISE).moments(points, np.full((FRAMES, POINTS), CERTAIN))
    np.testing.assert_array_equal(means, points.transpose(0, 2, 1).reshape(2 * FRAMES, POINTS))
    assert not total.any()


def test_each_observation_is_predicted_from_the_others() -> None:
    covariance, points = paths()
    confidence, weight = partly_seen()
    points = np.where(confidence[..., None] > 0, points, 0.0)
    distances, determinants = ImageDensity.of(covariance, NOISE).left_out(points, confidence, weight)
    assert (distances[confidence == 0] == 0).all()
    assert (determinants[confidence == 0] == 1).all()
    for point in range(POINTS):
        seen = np.flatnonzero(confidence[:, point] > 0)
        for frame in seen:
            others = seen[seen != frame]
            rows, own = rows_of(others), rows_of(np.array([frame]))
            inner = covariance[np.ix_(rows, rows)] + np.diag(noise_of(weight[others, point]))
            gain = np.linalg.solve(inner, covariance[np.ix_(rows, own)]).T
            spread = covariance[np.ix_(own, own)] - gain @ covariance[np.ix_(rows, own)]
            spread += np.diag(noise_of(confidence[[frame], point]))
            apart = points[frame, point] - gain @ points[others, point].ravel()
            assert distances[frame, point] == pytest.approx(apart @ np.linalg.solve(spread, apart), rel=1e-6, abs=1e-9)
            assert determinants[frame, point] == pytest.approx(np.linalg.det(spread), rel=1e-6)


def test_batches_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    covariance, points = paths()
    confidence, weight = partly_seen()
    points = np.where(confidence[..., None] > 0, points, 0.0)
    density = ImageDensity.of(covariance, NOISE)
    whole = [*density.moments(points, weight), *density.left_out(points, confidence, weight)]
    monkeypatch.setattr(observation_model, "BATCH_NUMBERS", 1)
    single = [*density.moments(points, weight), *density.left_out(points, confidence, weight)]
    for one, other in zip(whole, single, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10)


def test_the_noise_is_raised_to_its_floor() -> None:
    covariance, _ = paths()
    raised = ImageDensity.of(covariance, NOISE, least=4 * NOISE)
    assert raised.noise == 4 * NOISE
    np.testing.assert_allclose(
        np.linalg.inv(raised.precision), covariance + 3 * NOISE * np.eye(2 * FRAMES), rtol=1e-8, atol=1e-10
    )
    assert ImageDensity.of(covariance, NOISE, least=NOISE / 2).noise == NOISE


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_outliers_and_their_share_are_found_from_a_wrong_initial_share(share: float) -> None:
    covariance, points = paths()
    random = np.random.default_rng(3)
    wrong = random.random((FRAMES, POINTS)) < share
    points[wrong] = random.uniform(-15, 15, (wrong.sum(), 2))
    confidence = np.ones((FRAMES, POINTS))
    weight, expected = confidence, 0.05
    for _ in range(4):
        weight, expected = inlier_probabilities(covariance, NOISE, points, confidence, weight, share=expected)
    assert expected == pytest.approx(wrong.mean(), abs=0.02)
    assert (weight[wrong] < 0.5).mean() > 0.9
    assert (weight[~wrong] < 0.5).mean() < 0.03


def test_hidden_observations_do_not_affect_the_outlier_share() -> None:
    covariance, points = paths()
    hidden = np.zeros((FRAMES, POINTS))
    probability, share = inlier_probabilities(covariance, NOISE, 0 * points, hidden, hidden, share=0.1)
    assert not probability.any()
    assert share == 0.1
    clean, share = inlier_probabilities(covariance, NOISE, points, 1 - hidden, 1 - hidden, share=0.0)
    assert share == SHARE_BOUNDS[0], "an outlier stays possible"
    assert clean.min() > 0.5


def test_an_overconfident_covariance_does_not_reject_all_observations() -> None:
    covariance, points = paths()
    ones = np.ones((FRAMES, POINTS))
    tight = covariance / 400
    probability, share = inlier_probabilities(tight, NOISE / 400, points, ones, ones, share=0.01)
    assert (probability < 0.5).mean() < 0.05
    assert share < 0.05

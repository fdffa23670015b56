"""Noise and number of modes estimated from the tracks, and their effect on the default."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, gallery, solve
from pliant.solver.cameras.multistart import scaled_prior_weight
from pliant.solver.evaluation import metrics
from pliant.solver.model.expectation_maximisation import ANNEALING_START, ModelOrder, improve, learned, scratch
from pliant.solver.model.marginal_likelihood import CAMERA_PRIOR_WEIGHT
from pliant.solver.model.model_order import MIN_JUDGED_POINTS, select_model_order
from pliant.solver.model.so3 import exponential
from pliant.solver.tracks.noise import roughness, typical_roughness, white_noise

FRAMES = 30
SIGMA = 0.08
PAIRS = exponential(np.stack([np.linspace(-0.6, 0.6, FRAMES), np.zeros(FRAMES), np.zeros(FRAMES)], axis=1))[:, :2]


def tracks(points: int, *, modes: int, sigma: float) -> np.ndarray:
    """A body of random points that turns, moves along some slow modes and is seen with noise, shape (F, P, 2)."""
    random = np.random.default_rng(3)
    time = np.linspace(0, 1, FRAMES)
    waves = 0.5 * np.cos(np.pi * np.outer(time, 1 + np.arange(modes)) + np.arange(modes))
    shapes = random.standard_normal((points, 3)) + np.einsum(
        "fk,pkc->fpc", waves, random.standard_normal((points, modes, 3))
    )
    return np.einsum("fic,fpc->fpi", PAIRS, shapes) + sigma * random.standard_normal((FRAMES, points, 2))


def gram_of(points: np.ndarray) -> np.ndarray:
    rows = points.transpose(0, 2, 1).reshape(2 * FRAMES, -1)
    return np.asarray(rows @ rows.T / rows.shape[1])


@pytest.mark.parametrize("sigma", [0.01, 0.08])
def test_all_estimators_recover_white_noise(sigma: float) -> None:
    points = tracks(3000, modes=2, sigma=sigma)
    assert roughness(gram_of(points)) ** 0.5 == pytest.approx(sigma, rel=0.1)
    assert white_noise(gram_of(points)) ** 0.5 == pytest.approx(sigma, rel=0.1)
    assert typical_roughness(points) == pytest.approx(sigma, rel=0.1)


def test_noise_estimates_of_exact_tracks_are_close_to_zero() -> None:
    points = tracks(3000, modes=2, sigma=0.0)
    assert white_noise(gram_of(points)) < 1e-6
    assert typical_roughness(points) < 3e-3


def test_noise_grows_with_the_square_of_the_unit() -> None:
    gram = gram_of(tracks(300, modes=1, sigma=0.05))
    assert roughness(9 * gram) == pytest.approx(9 * roughness(gram))
    assert white_noise(9 * gram) == pytest.approx(9 * white_noise(gram))


def test_few_points_give_the_roughness_as_noise() -> None:
    gram = gram_of(tracks(20, modes=1, sigma=0.05))  # rank 20 of 60: the median eigenvalue is 0 whatever the noise
    assert white_noise(gram) == roughness(gram)
    assert white_noise(gram) ** 0.5 == pytest.approx(0.05, rel=0.2)


def test_a_few_wrong_points_do_not_make_tracks_rough() -> None:
    points = tracks(200, modes=2, sigma=0.01)
    points[::3, :20] += 2.0
    assert typical_roughness(points) < 0.015
    assert roughness(gram_of(points)) > 0.1


@pytest.mark.parametrize("frames", [3, 4])
def test_short_sequences_use_lower_differences(frames: int) -> None:
    noise = 0.1 * np.random.default_rng(0).standard_normal((frames, 5000, 2))
    assert typical_roughness(noise) == pytest.approx(0.1, rel=0.05)


def test_the_camera_prior_is_weaker_with_strong_noise() -> None:
    weights = [scaled_prior_weight(gram_of(tracks(500, modes=2, sigma=sigma))) for sigma in (0.0, 0.03, 0.1)]
    assert weights[0] == pytest.approx(CAMERA_PRIOR_WEIGHT, rel=1e-3)
    assert weights[1] == pytest.approx(CAMERA_PRIOR_WEIGHT / 2, rel=0.1)
    assert weights[2] < CAMERA_PRIOR_WEIGHT / 9


def test_strong_noise_is_learned_though_a_small_start_misses_it() -> None:
    gram = gram_of(tracks(500, modes=2, sigma=SIGMA))
    small = improve(scratch(gram, PAIRS, ModelOrder()), gram, PAIRS, iterations=60, warm=ANNEALING_START)
    assert small.noise_variance**0.5 < SIGMA / 3
    assert learned(gram, PAIRS, ModelOrder(8, noisy_start=True)).noise_variance ** 0.5 == pytest.approx(SIGMA, rel=0.15)


def test_fine_deformation_is_not_learned_as_noise() -> None:
    assert learned(gram_of(tracks(500, modes=6, sigma=0.0)), PAIRS, ModelOrder()).noise_variance ** 0.5 < 1e-3


@pytest.mark.slow
def test_the_number_of_modes_is_cross_validated() -> None:
    few = [select_model_order(tracks(40, modes=modes, sigma=SIGMA), PAIRS) for modes in (0, 2)]
    assert [each.max_modes for each in few] == [0, 2]
    assert all(each.noisy_start for each in few)
    assert select_model_order(tracks(40, modes=8, sigma=0.02), PAIRS).max_modes == 8


@pytest.mark.slow
def test_many_points_support_at_least_the_true_modes() -> None:
    assert select_model_order(tracks(400, modes=2, sigma=SIGMA), PAIRS).max_modes >= 2
    assert select_model_order(tracks(400, modes=8, sigma=0.02), PAIRS).max_modes >= 8


def test_the_model_order_is_not_limited_without_noise_or_with_few_points() -> None:
    assert select_model_order(tracks(40, modes=2, sigma=0.0), PAIRS) == ModelOrder()
    assert select_model_order(tracks(MIN_JUDGED_POINTS - 1, modes=2, sigma=SIGMA), PAIRS) == ModelOrder()


@pytest.mark.parametrize("points", [40, pytest.param(400, marks=pytest.mark.long)])
@pytest.mark.parametrize("known", [True, pytest.param(False, marks=pytest.mark.long)])
@pytest.mark.slow
def test_the_default_has_lower_error_with_strong_noise_than_the_papers_prior(known: bool, points: int) -> None:
    face = gallery.face(30 if known else 60, points)  # known cameras need fewer frames
    cameras = KnownCamera.from_arrays(face.rotations, face.scales) if known else None
    noisy = gallery.corrupt(face, noise=0.05, seed=1).tracks

    def error(settings: Settings) -> float:
        return metrics.e3d_frame(solve(noisy, cameras=cameras, settings=settings).shapes, face.shapes)

    assert error(Settings(basis_size=2)) < 0.8 * error(Settings(prior="smooth", basis_size=2))


@pytest.mark.long
@pytest.mark.slow
def test_the_report_states_the_number_of_modes_and_the_reason() -> None:
    face = gallery.face(30, 60)
    noisy = gallery.corrupt(face, noise=0.03, seed=1).tracks
    assert "do not make other points more probable" in solve(noisy).choices.reasons["modes"]
    assert "modes of deformation, noise of" in solve(face.tracks).choices.reasons["modes"]

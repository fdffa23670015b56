"""The Gaussian shape prior: EM, its accuracy, and its limits."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from learning import dense_precisions, learn
from pliant.solver import KnownCamera, Settings, gallery, solve
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.evaluation import metrics
from pliant.solver.model import expectation_maximisation
from pliant.solver.model.expectation_maximisation import (
    MAX_DENSE_FRAMES,
    MAX_ITERATIONS,
    MAX_MODES,
    MEAN_MODE_STD,
    WALK_VARIANCE_FLOOR,
    ModelOrder,
    annealed,
    freed,
    improve,
    learned,
    scratch,
)
from pliant.solver.model.random_walk import random_walk
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import exponential
from pliant.solver.tracks.frame_selection import informative_frames
from pliant.solver.tracks.normalization import normalize

FRAMES = 14


def drawn(points: int = 4000, noise: float = 1e-4) -> tuple[ShapeCovariance, np.ndarray, np.ndarray]:
    """A covariance, cameras that turn, and the Gram matrix of points drawn from it."""
    random = np.random.default_rng(5)
    time = np.linspace(0, 1, FRAMES)
    modes = np.stack([0.2 * np.sin(2 * np.pi * time), 0.1 * np.cos(5 * time)], axis=1)
    axis_covariance = np.diag([0.5, 1.0, 1.5])
    truth = ShapeCovariance(np.diag([0.2, 0.4, 0.6]), axis_covariance, modes, 1e-4, noise, np.inf)
    angles = np.stack([0.3 * np.sin(7 * time), 1.2 * np.sin(4 * time), 0.2 * time], axis=1)
    projections = exponential(angles)[:, :2]
    frames = np.linalg.cholesky(truth.over_frames())
    middle = random.standard_normal((points, 3)) @ np.sqrt(truth.mean_covariance)
    deform = np.einsum("fg,pgc->fpc", frames, random.standard_normal((points, FRAMES, 3))) @ np.sqrt(axis_covariance)
    image = np.einsum("fic,fpc->fip", projections, middle + deform) + noise**0.5 * random.standard_normal(
        (FRAMES, 2, points)
    )
    rows = image.reshape(2 * FRAMES, points)
    return truth, projections, rows @ rows.T / points


def test_no_em_iteration_increases_the_nll() -> None:
    _, projections, gram = drawn(300)
    covariance = scratch(gram, projections, ModelOrder())
    likelihoods = []
    for _ in range(12):
        covariance = improve(covariance, gram, projections, iterations=1)
        likelihoods.append(covariance.nll)
    assert (np.diff(likelihoods) < 1e-9).all()
    assert likelihoods[0] - likelihoods[-1] > 0.01


def test_the_covariance_of_sampled_points_is_recovered() -> None:
    truth, projections, gram = drawn()
    found = improve(scratch(gram, projections, ModelOrder()), gram, projections, iterations=300, warm=1e-2)
    for mine, known in (
        (found.over_frames(), truth.over_frames()),
        (found.axis_covariance, truth.axis_covariance),
        (found.mean_covariance, truth.mean_covariance),
    ):
        assert np.linalg.norm(mine - known) < 0.2 * np.linalg.norm(known)
    assert np.linalg.norm(found.over_frames()) > 0.8 * np.linalg.norm(truth.over_frames())


@pytest.mark.parametrize("max_modes", [2, 64])
def test_the_more_probable_of_two_runs_is_returned(max_modes: int) -> None:
    _, projections, gram = drawn(300)
    found = learned(gram, projections, ModelOrder(max_modes))
    cold = improve(
        scratch(gram, projections, ModelOrder(max_modes)),
        gram,
        projections,
        iterations=MAX_ITERATIONS,
        max_modes=max_modes,
    )
    warm = improve(
        freed(annealed(gram, projections, ModelOrder(max_modes), iterations=MAX_ITERATIONS)),
        gram,
        projections,
        iterations=MAX_ITERATIONS // 2,
        max_modes=max_modes,
    )
    assert found.nll == min(cold.nll, warm.nll)
    assert cold.nll != warm.nll
    assert found.modes.shape[1] <= max_modes


def test_freeing_the_mean_position_adds_exactly_one_mode() -> None:
    truth, _, _ = drawn(10)
    free = freed(truth)
    np.testing.assert_array_equal(free.modes[:, :-1], truth.modes)
    np.testing.assert_allclose(free.over_frames() - truth.over_frames(), MEAN_MODE_STD**2)
    assert free.mean_covariance is truth.mean_covariance
    assert (free.walk_variance, free.noise_variance) == (truth.walk_variance, truth.noise_variance)


def test_precisions_are_the_inverse_of_the_covariance() -> None:
    truth, _, _ = drawn(10)
    turn = exponential(np.array([0.3, -0.5, 0.8]))
    turned = replace(
        truth,
        mean_covariance=turn @ truth.mean_covariance @ turn.T,
        axis_covariance=np.asarray(truth.axis_covariance + 0.2),
    )
    basis, precisions = turned.precisions()
    whole = np.kron(np.ones((FRAMES, FRAMES)), turned.mean_covariance) + np.kron(
        turned.over_frames(), turned.axis_covariance
    )
    inverse = np.zeros((FRAMES, 3, FRAMES, 3))
    for axis in range(3):
        inverse[:, axis, :, axis] = dense_precisions(precisions)[axis]
    back = np.kron(np.eye(FRAMES), np.linalg.inv(basis))
    np.testing.assert_allclose(
        back.T @ inverse.reshape(3 * FRAMES, -1) @ back, np.linalg.inv(whole), rtol=1e-6, atol=1e-4
    )


def test_modes_are_interpolated_linearly_between_the_used_frames() -> None:
    truth, _, _ = drawn(10)
    wide = truth.stretched(np.arange(FRAMES) * 2, 2 * FRAMES - 1)
    np.testing.assert_array_equal(wide.modes[::2], truth.modes)
    np.testing.assert_allclose(wide.modes[1::2], (truth.modes[1:] + truth.modes[:-1]) / 2)
    assert np.trace(random_walk(31, ordered=True)) == pytest.approx(31)


def test_the_walk_variance_never_falls_below_its_floor() -> None:
    _, projections, gram = drawn(300, noise=0.0)
    assert (
        improve(scratch(gram, projections, ModelOrder()), gram, projections, iterations=40).walk_variance
        >= WALK_VARIANCE_FLOOR
    )


@pytest.fixture(scope="module")
def face() -> gallery.Sequence:
    return gallery.face(24, 400)


def error(face: gallery.Sequence, *, known: bool, settings: Settings, spoiled: gallery.Sequence | None = None) -> float:
    cameras = KnownCamera.from_arrays(face.rotations, face.scales) if known else None
    given = (spoiled or face).tracks
    return metrics.e3d_frame(solve(given, cameras=cameras, settings=settings).shapes, face.shapes)


@pytest.mark.parametrize("known", [True, pytest.param(False, marks=pytest.mark.long)])
@pytest.mark.slow
def test_the_gaussian_prior_reduces_the_error_of_a_face(face: gallery.Sequence, known: bool) -> None:
    smooth = error(face, known=known, settings=Settings(prior="smooth"))
    gaussian = error(face, known=known, settings=Settings())
    assert 1e-4 < gaussian < 0.6 * smooth


@pytest.mark.long
@pytest.mark.slow
def test_gross_outliers_are_rejected_and_reported(face: gallery.Sequence) -> None:
    spoiled = gallery.corrupt(face, outliers=0.1, seed=1)
    assert error(face, known=True, settings=Settings(), spoiled=spoiled) < 0.03
    cameras = KnownCamera.from_arrays(face.rotations, face.scales)
    found = solve(spoiled.tracks, cameras=cameras)
    moved = np.linalg.norm(spoiled.tracks.points - face.tracks.points, axis=2)
    gross = moved > 0.3 * found.choices.unit
    assert (found.weights[gross] < 0.1).mean() > 0.98
    assert (found.weights[moved == 0] > 0.1).mean() > 0.95
    assert np.median(found.residuals[gross]) > 0.2 * found.choices.unit  # they are reported, not hidden


def test_frames_with_few_visible_points_are_not_learned_from() -> None:
    visible = np.ones((10, 50))
    visible[3] = 0
    visible[4, 4:] = 0
    assert informative_frames(visible).tolist() == [True] * 3 + [False] * 2 + [True] * 5
    assert informative_frames(np.eye(10)).all()


@pytest.mark.slow
def test_a_stop_leaves_the_rotations_of_the_start(face: gallery.Sequence) -> None:
    projections = np.asarray(face.rotations)[:, :2]
    points = face.tracks.points - face.tracks.points.mean(axis=1, keepdims=True)
    rows = points.transpose(0, 2, 1).reshape(48, -1) / points.std()
    estimate = CameraEstimate(
        np.asarray(face.rotations),
        np.ones(24),
        np.zeros((24, 2)),
        1,
        rows @ rows.T / 400,
        rows.reshape(24, 2, -1).transpose(0, 2, 1),
    )
    normalized = normalize(face.tracks)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "pliant.solver.refinement.covariance_learning.learn_with_early_stopping", None
        )  # a stop learns nothing more
        stopped, _ = learn(estimate, normalized, turning=True, should_stop=lambda: True)
    np.testing.assert_allclose(
        stopped.rotations, np.asarray(face.rotations) @ np.asarray(face.rotations)[0].T, atol=1e-12
    )
    moved, covariance = learn(estimate, normalized, turning=True)
    assert np.abs(moved.rotations - stopped.rotations).max() > 1e-5
    assert (
        covariance.nll
        < improve(scratch(estimate.gram, projections, ModelOrder()), estimate.gram, projections, iterations=5).nll
    )


def test_a_long_rigid_film_without_modes_is_learned() -> None:
    frames = MAX_DENSE_FRAMES + 10
    angles = np.linspace(0, 1, frames)[:, None] * (0.0, 1.0, 0.0)
    projections = exponential(angles)[:, :2]
    rng = np.random.default_rng(0)
    rows = projections.reshape(-1, 3) @ rng.normal(size=(3, 50)) + 1e-4 * rng.normal(size=(2 * frames, 50))
    gram = rows @ rows.T / 50
    rigid = replace(
        scratch(gram, projections, ModelOrder()), modes=np.zeros((frames, 0)), walk_variance=WALK_VARIANCE_FLOOR
    )
    for max_modes in (0, MAX_MODES):
        found = improve(rigid, gram, projections, iterations=2, max_modes=max_modes)
        assert found.modes.shape == (frames, 0)
        assert np.isfinite(found.nll)


def test_eigenvalues_that_do_not_converge_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    failing = SimpleNamespace(dsyevd=lambda matrix, lower: (np.ones(len(matrix)), matrix, 1))
    monkeypatch.setattr(expectation_maximisation, "lapack", failing)
    with pytest.raises(np.linalg.LinAlgError, match="did not converge"):
        expectation_maximisation._split(np.eye(5), 1e-6, 3, ordered=True)


@pytest.mark.parametrize("ordered", [True, False])
def test_modes_and_walk_reproduce_a_covariance_of_their_form(ordered: bool) -> None:
    modes, walk_variance = np.linalg.qr(np.random.default_rng(0).normal(size=(12, 3)))[0] * [3.0, 2.0, 1.0], 1e-3
    over_frames = modes @ modes.T + walk_variance * random_walk(12, ordered)
    found, variance = expectation_maximisation._split(over_frames, 1e-9, 8, ordered=ordered)
    assert found.shape == (12, 3)
    np.testing.assert_allclose(found @ found.T + variance * random_walk(12, ordered), over_frames, atol=1e-12)


def test_only_modes_that_move_by_more_than_the_noise_count_as_deformations() -> None:
    truth, _, _ = drawn()
    assert truth.num_deforming() == 2
    turned = replace(truth, modes=truth.modes @ np.array([[0.6, -0.8], [0.8, 0.6]]))
    assert turned.num_deforming() == 2, "another basis of the same modes"
    assert replace(truth, modes=np.hstack([truth.modes, np.full((FRAMES, 1), 0.5)])).num_deforming() == 2
    assert replace(truth, noise_variance=0.01).num_deforming() == 1
    assert replace(truth, modes=np.zeros((FRAMES, 0))).num_deforming() == 0

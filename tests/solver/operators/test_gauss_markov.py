"""The Gaussian prior over frames as a tridiagonal matrix and modes: its inverse and its preconditioner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from learning import dense_precisions
from pliant.solver import gallery, threads_limited
from pliant.solver.linear import points
from pliant.solver.linear.deflation import build_coarse
from pliant.solver.linear.preconditioner import build_preconditioner
from pliant.solver.linear.woodbury import MeanModes
from pliant.solver.model.random_walk import walk_bands
from pliant.solver.operators import gauss_markov
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.operators.normal_equations import Operator

FRAMES, POINTS = 14, 23


def roots() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A separate mean for each coordinate, and three waves."""
    time = np.linspace(0, 1, FRAMES)
    waves = 0.3 * np.stack([np.sin(5 * time), np.cos(7 * time), time], axis=1)
    first, second, third = (np.column_stack([waves, np.full(FRAMES, mean)]) for mean in (0.2, 1.0, 0.0))
    return first, second, third


def prior(drift: float = 1e-3) -> PathPrior:
    bands, norm = walk_bands(FRAMES, ordered=True)
    return PathPrior.of(bands * norm / drift, roots())


def operator(weights: np.ndarray) -> Operator:
    projections = np.asarray(gallery.face(FRAMES, 30).rotations)[:, :2]
    return Operator(projections, weights, np.zeros((2, FRAMES)), None, 0.0, None, prior().scaled(0.02))


def a_frame_s(weight: float) -> np.ndarray:
    """One weight for all points of a frame."""
    each = weight * np.random.default_rng(1).uniform(0.5, 2, (FRAMES, 2, 1))
    return np.ascontiguousarray(np.broadcast_to(each, (FRAMES, 2, POINTS)))


def test_the_path_prior_is_the_inverse_of_the_covariance() -> None:
    bands, norm = walk_bands(FRAMES, ordered=True)
    chain = np.diag(bands[0]) + np.diag(bands[1, :-1], 1) + np.diag(bands[1, :-1], -1)
    for found, root in zip(dense_precisions(prior()), roots(), strict=True):
        covariance = 1e-3 * np.linalg.inv(chain) / norm + root @ root.T
        np.testing.assert_allclose(found @ covariance, np.eye(FRAMES), atol=1e-9)


def test_product_and_value_match_the_dense_precision() -> None:
    given, shapes = (
        operator(np.zeros((FRAMES, 2, POINTS))),
        np.random.default_rng(0).standard_normal((FRAMES, 3, POINTS)),
    )
    assert given.quadratic is not None
    product = np.einsum("cfg,gcp->fcp", dense_precisions(given.quadratic), shapes)
    np.testing.assert_allclose(given.apply(shapes), product, atol=1e-10)
    assert given.quadratic.value(shapes) == pytest.approx(float((product * shapes).sum()), rel=1e-12)


def test_the_loosest_directions_have_the_smallest_eigenvalues() -> None:
    found = prior().loosest(2)
    for (directions, held), matrix in zip(found, dense_precisions(prior()), strict=True):
        values, vectors = np.linalg.eigh(matrix)
        np.testing.assert_allclose(held, values[:2], rtol=1e-2)
        np.testing.assert_allclose(np.abs(directions.T @ vectors[:, :2]), np.eye(2), atol=1e-2)


def test_one_weight_per_frame_is_inverted_exactly() -> None:
    given = operator(a_frame_s(300.0))
    assert build_coarse(given, np.zeros(POINTS)) is None
    shapes = np.random.default_rng(2).standard_normal((FRAMES, 3, POINTS))
    np.testing.assert_allclose(points.build(given)(given.apply(shapes)), shapes, atol=1e-6)
    np.testing.assert_allclose(build_preconditioner(given)(given.apply(shapes)), shapes, atol=0.02)


def test_preconditioner_is_symmetric_positive_definite_with_hidden_frames() -> None:
    weights = a_frame_s(300.0)
    weights[3:6] = 0
    precondition = build_preconditioner(operator(weights))
    size = FRAMES * 3 * POINTS
    units = np.eye(size).reshape(size, FRAMES, 3, POINTS)[:: POINTS // 2]
    matrix = np.stack([precondition(unit).ravel()[:: POINTS // 2] for unit in units])
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-6, atol=1e-9)
    assert np.linalg.eigvalsh(matrix).min() > 0


def test_single_precision_barely_changes_the_preconditioner() -> None:
    given, r = operator(a_frame_s(300.0)), np.random.default_rng(3).standard_normal((FRAMES, 3, POINTS))
    double, single = (build_preconditioner(each)(r.astype(kind)) for each, kind in both(given))
    assert single.dtype == np.float32
    assert np.linalg.norm(single - double) < 1e-3 * np.linalg.norm(double)


def both(given: Operator) -> list[tuple[Operator, type]]:
    return [(given, np.float64), (given.rounded(np.dtype(np.float32)), np.float32)]


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gauss_markov, "POINT_BLOCK", 4)
    monkeypatch.setattr(gauss_markov, "SMALLEST", 1)
    given, r = operator(a_frame_s(300.0)), np.random.default_rng(4).standard_normal((FRAMES, 3, POINTS))
    modes, found = MeanModes.of(given), []
    for threads in (1, 2):
        with threads_limited(threads):
            out = np.zeros_like(r)
            modes.add(r, out)
            found.append((out, given.apply(r), prior().value(r)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])
    assert found[0][2] == found[1][2]


def test_the_preconditioner_is_finite_with_a_prior_of_weight_zero() -> None:
    given = operator(a_frame_s(300.0))
    nothing = replace(given, quadratic=prior().scaled(0.0))
    shapes = np.random.default_rng(5).standard_normal((FRAMES, 3, POINTS))
    assert np.isfinite(build_preconditioner(nothing)(shapes)).all()

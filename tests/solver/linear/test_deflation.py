"""The coarse correction: exact on its span, symmetric, and effective for hidden points."""

from __future__ import annotations

import numpy as np
from learning import dense_precisions
from pliant.solver import gallery
from pliant.solver.linear import points
from pliant.solver.linear.conjugate_gradient import Linear, conjugate_gradient
from pliant.solver.linear.deflation import build_coarse
from pliant.solver.linear.preconditioner import _by_inverse, build_preconditioner, temporal_matrix
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.operators.normal_equations import Operator
from scipy import linalg


def operator(*, hidden: float) -> Operator:
    random = np.random.default_rng(0)
    frames, points = 18, 90
    made = gallery.face(frames, points)
    time = np.linspace(0, 1, frames)
    modes = np.stack([np.ones(frames), np.sin(6 * time), np.cos(9 * time)], axis=1)
    bands = np.stack([np.full(frames, 1e4), np.zeros(frames)])
    prior = PathPrior.of(bands, (0.2**0.5 * modes,) * 3).scaled(1e-3)
    weights = np.where(random.random((frames, 1, points)) < hidden, 0.0, 500.0) * np.ones((1, 2, 1))
    projections = np.asarray(made.rotations)[:, :2]
    return Operator(projections, weights, np.zeros((2, frames)), None, 0.0, None, prior)


def alike(given: Operator) -> Linear:
    """Return the inverse with one mean weight per frame."""
    assert given.quadratic is not None
    whole = temporal_matrix(given)
    whole += (
        linalg.block_diag(*dense_precisions(given.quadratic))
        .reshape(3, 18, 3, 18)
        .transpose(1, 0, 3, 2)
        .reshape(54, 54)
    )
    return _by_inverse(whole, given.weights.dtype)


def test_points_with_equal_weights_need_no_correction() -> None:
    assert build_coarse(operator(hidden=0.0), np.zeros(90)) is None


def test_the_coarse_correction_is_exact_on_its_span() -> None:
    given = operator(hidden=0.4)
    coarse = build_coarse(given, np.zeros(90))
    assert coarse is not None
    inner = np.random.default_rng(1).standard_normal((sum(each.shape[1] for each in coarse.modes), 90))
    shapes, first = np.zeros((18, 3, 90)), 0
    for axis, modes in enumerate(coarse.modes):
        shapes[:, axis] = modes @ inner[first : first + modes.shape[1]]
        first += modes.shape[1]
    found = np.zeros_like(shapes)
    coarse.add(given.apply(shapes), found)
    np.testing.assert_allclose(found, shapes, atol=1e-7)


def test_the_whole_preconditioner_is_symmetric_and_positive() -> None:
    given = operator(hidden=0.4)
    precondition = points.build(given)
    one, two = np.random.default_rng(2).standard_normal((2, 18, 3, 90))
    np.testing.assert_allclose(np.vdot(precondition(one), two), np.vdot(one, precondition(two)), rtol=1e-9)
    assert np.vdot(precondition(one), one) > 0


def test_the_correction_halves_the_iterations_with_hidden_points() -> None:
    given = operator(hidden=0.4)
    b = np.random.default_rng(3).standard_normal((18, 3, 90))

    def iterations(precondition: object) -> int:
        return conjugate_gradient(
            given.apply, b.copy(), precondition=precondition, reduction=1e-4, max_iterations=2000  # type: ignore[arg-type]
        ).iterations  # fmt: skip

    assert 1 < iterations(build_preconditioner(given)) < 0.5 * iterations(alike(given))

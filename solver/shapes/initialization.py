"""Initial shapes: the pseudo-inverse, and least squares with uniform weights."""

from __future__ import annotations

from itertools import count

import numpy as np
from pliant.solver.energy.problem import Problem
from pliant.solver.linear.conjugate_gradient import conjugate_gradient
from pliant.solver.linear.preconditioner import build_preconditioner
from pliant.solver.operators.normal_equations import Operator
from pliant.solver.pulse import ShouldStop, never, pulse
from pliant.solver.records import Array, Floats
from pliant.solver.shapes.irls import inner_precision

EXACT, ROUGH, MAX_START_ITERATIONS = 1e-4, 0.1, 200
"""Reduction of the residual for a final least-squares result and for a starting point; maximum number of iterations."""

START_NOISE_STD = 0.1
"""Noise standard deviation, normalized units, assumed for the starting point with a Gaussian prior."""


def pseudo_inverse(problem: Problem, translations: Floats) -> Array:
    """Return R†(W − t) per frame: flat shapes in the image plane of each frame, with hidden points at the centre.

    These are the minimum-norm shapes that explain the tracks (Dai, Deng, He 2017, Fig. 1, first column).
    """
    target = (problem.points - translations[:, :, None]) * (problem.confidence > 0)[:, None]
    inverse = np.linalg.pinv(problem.projections.astype(np.float64))
    flat: Array = np.matmul(inverse, target).astype(problem.points.dtype)
    return flat


def uniform_solution(problem: Problem, translations: Floats, *, should_stop: ShouldStop = never) -> Array:
    """Return the least-squares shapes with equal weights for all observations (eq. 5 if λ2 is 0).

    They minimise ‖W − R S‖² + λ1 ‖H S‖² + λ2 ‖A S‖²: the result for least squares, the starting point for robust losses.
    With a Gaussian prior the starting point assumes large noise (`START_NOISE_STD`): shapes that fit an outlier give it full weight,
    and reweighting would reject it only slowly. `should_stop` is called in every iteration; once it returns True, the shapes so far are
    returned, after at least one iteration.
    """
    asked = count()
    should_stop()

    def stops() -> bool:
        before = next(asked)  # called twice before the first iteration ends
        return should_stop() and before > 1

    reduction = EXACT if problem.loss == "l2" else ROUGH
    operator = _uniform(problem, reduction)
    should_stop()
    right_hand_side = _right_hand_side(problem, translations, operator)
    should_stop()
    precondition = build_preconditioner(operator)
    should_stop()
    solved = conjugate_gradient(
        operator.apply, right_hand_side, precondition=precondition, reduction=reduction, max_iterations=MAX_START_ITERATIONS,
        should_stop=stops,
    )  # fmt: skip
    should_stop()
    return solved.x.astype(problem.points.dtype, copy=False)


def _uniform(problem: Problem, reduction: float) -> Operator:
    """Return the normal equations with equal weights, in a precision that allows the reduction."""
    weights = np.array(np.broadcast_to(problem.confidence[:, None, :], problem.points.shape))
    if problem.quadratic is not None and problem.weights.temporal > 0:
        weights *= weights.dtype.type(problem.weights.temporal / START_NOISE_STD**2)
    operator = Operator(
        problem.projections, weights, problem.bands, problem.laplacian, problem.weights.spatial, None, problem.quadratic
    )
    return operator.rounded(inner_precision(operator, reduction))


def _right_hand_side(problem: Problem, translations: Floats, operator: Operator) -> Array:
    target = problem.points - translations[:, :, None].astype(problem.points.dtype)
    pulse()
    return operator.right_hand_side(target.astype(operator.weights.dtype, copy=False))

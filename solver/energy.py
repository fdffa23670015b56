"""The energy of a state, evaluated in full: loss, smoothness in time and space, rank."""

from __future__ import annotations

import numpy as np
from pliant.solver.loss import loss_value
from pliant.solver.low_rank import rank_penalty
from pliant.solver.operator import add_product
from pliant.solver.records import Floats
from pliant.solver.state import Array, Problem


def residuals(problem: Problem, shapes: Array, translations: Floats) -> Array:
    """Return w − s R x − t, shape `(F, 2, P)`, normalised units; meaningless where hidden."""
    image = np.matmul(problem.projections, shapes)
    image += translations[:, :, None].astype(shapes.dtype)
    return np.subtract(problem.points, image, out=image)


def objective(problem: Problem, shapes: Array, residual: Array) -> float:
    """Return E = Σ v ρ(r) + λ1 ‖HX‖² + λ2 ‖AX‖² + rank penalty (Dai, Deng, He 2017, eq. 7, and ours)."""
    weights = problem.weights
    total = loss_value(residual, problem.confidence, loss=problem.loss, scale=weights.robust_scale)
    return total + smoothness(problem, shapes) + rank_penalty(shapes, weights.low_rank, weights.rank_floor)


def smoothness(problem: Problem, shapes: Array) -> float:
    """Return λ1 ‖HX‖² + λ2 ‖AX‖², the first replaced by λ1 tr XᵀQX with a Gaussian prior."""
    weights = problem.weights
    total = 0.0
    if problem.quadratic is not None:
        image = np.zeros_like(shapes)
        add_product(problem.quadratic, shapes, image)
        total += float(np.einsum("fcp,fcp->", image, shapes, dtype=np.float64))
    elif weights.temporal > 0:
        order = len(problem.bands) - 1
        for frame in range(len(shapes) - order):
            step = np.diff(shapes[frame : frame + order + 1], n=order, axis=0)
            total += weights.temporal * float(np.einsum("fcp,fcp->", step, step, dtype=np.float64))
    if problem.laplacian is not None and weights.spatial > 0:
        matrix = problem.laplacian.matrix.astype(shapes.dtype)
        for row in shapes.reshape(-1, shapes.shape[2]):
            bend = matrix @ row
            total += weights.spatial * float(np.dot(bend, bend))
    return total

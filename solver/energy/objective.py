"""The energy of a state: loss, temporal and spatial smoothness, rank penalty."""

from __future__ import annotations

import numpy as np
from pliant.solver.energy.low_rank import rank_penalty
from pliant.solver.energy.problem import Problem
from pliant.solver.energy.robust_loss import loss_value, loss_weights
from pliant.solver.operators.bending import bends_of, frames_together
from pliant.solver.operators.normal_equations import rows_of
from pliant.solver.records import Array, Floats
from pliant.solver.threads import SMALLEST, over_ranges


def residuals_of(problem: Problem, shapes: Array, translations: Floats, frame: int) -> Array:
    """Return the residuals of one frame, shape `(2, P)`."""
    image: Array = np.matmul(problem.projections[frame], shapes[frame])
    image += translations[frame][:, None].astype(shapes.dtype)
    np.subtract(problem.points[frame], image, out=image)
    return image


def loss_of(problem: Problem, residual: Array, frame: int) -> float:
    """Return Σ v ρ(r) of one frame for residuals r of shape `(2, P)`."""
    confidence = problem.confidence[frame : frame + 1]
    return loss_value(residual[None], confidence, loss=problem.loss, scale=problem.weights.robust_scale)


def weights_of(problem: Problem, residual: Array, frame: int) -> Array:
    """Return v ω(r) of one frame, shape `(2, P)`."""
    confidence = problem.confidence[frame : frame + 1]
    weights: Array = loss_weights(residual[None], confidence, loss=problem.loss, scale=problem.weights.robust_scale)[0]
    return weights


def prior(problem: Problem, shapes: Array) -> float:
    """Return the terms of the energy that do not depend on the tracks."""
    return smoothness(problem, shapes) + rank_penalty(shapes, problem.weights.low_rank)


def smoothness(problem: Problem, shapes: Array) -> float:
    """Return λ1 ‖HX‖² + λ2 ‖AX‖² (Dai, Deng, He 2017, eq. 7); with a Gaussian prior the first term is λ1 tr XᵀQX."""
    weights = problem.weights
    total = 0.0 if problem.quadratic is None else problem.quadratic.value(shapes)
    temporal = weights.temporal if problem.quadratic is None else 0.0
    laplacian = None if problem.laplacian is None else problem.laplacian.rounded(shapes.dtype)
    order, together = len(problem.bands) - 1, frames_together(len(shapes))
    parts = np.zeros(-(-len(shapes) // together))

    def work(start: int, stop: int) -> None:
        for part in range(start, stop):
            low, high = part * together, min((part + 1) * together, len(shapes))
            if temporal > 0:
                for frame in range(low, min(high, len(shapes) - order)):
                    parts[part] += temporal * _squared(np.diff(shapes[frame : frame + order + 1], n=order, axis=0))
            if laplacian is not None and weights.spatial > 0:
                parts[part] += weights.spatial * _squared(bends_of(laplacian, rows_of(shapes[low:high])))

    over_ranges(work, len(parts), smallest=max(1, SMALLEST // (together * shapes[0].size)))
    return total + float(parts.sum())


def _squared(array: Array) -> float:
    flat = array.ravel()
    return float(np.einsum("i,i->", flat, flat, dtype=np.float64))

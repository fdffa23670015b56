"""Additive multilevel preconditioner: the point-wise inverse (`linear.points`) on the finest and every coarser level."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.linear import points
from pliant.solver.linear.conjugate_gradient import Linear
from pliant.solver.operators.aggregation import Level, Matrix
from pliant.solver.operators.bending import add_transposed, frames_together, transposed
from pliant.solver.operators.normal_equations import Operator
from pliant.solver.records import Array
from pliant.solver.threads import SMALLEST, over_ranges


def build(operator: Operator) -> Linear:
    """Factor every level for one reweighting and return r ↦ Σ_l Π_l M_l⁻¹ Π_lᵀ r."""
    assert operator.laplacian is not None
    fine = points.build(operator)
    coarse: list[Coarser] = []
    weights = operator.weights
    for level in operator.laplacian.levels:
        weights = _carried(level.mean, weights)
        alike = replace(operator, weights=weights, laplacian=None)
        inverse = points.build(alike, operator.spatial_weight * level.bending)
        coarse.append(Coarser(level, inverse))

    def apply(r: Array, /, out: Array | None = None) -> Array:
        result = fine(r, out=out)
        _correct(coarse, r, result)
        return result

    return apply


@dataclass(frozen=True, slots=True, eq=False)
class Coarser:
    """A coarse level and its point-wise inverse."""

    level: Level
    inverse: Linear


def _correct(coarse: list[Coarser], r: Array, out: Array) -> None:
    """Add the corrections of all levels for the residual r to `out`."""
    if not coarse:
        return
    first, *rest = coarse
    residual = _carried(first.level.down, r)
    correction = first.inverse(residual)
    _correct(rest, residual, correction)
    _carried(first.level.up, correction, onto=out)


def _carried(matrix: Matrix, array: Array, onto: Array | None = None) -> Array:
    """Return the product of the matrix with every row of `(F, k, P)`, or add it to `onto`."""
    frames, rows, points = array.shape
    result = np.zeros((frames, rows, matrix.shape[0]), dtype=array.dtype) if onto is None else onto
    together = frames_together(frames)

    def work(start: int, stop: int) -> None:
        for low in range(start * together, min(stop * together, frames), together):
            part = slice(low, min(low + together, frames))
            product = matrix @ transposed(array[part].reshape(-1, points))
            add_transposed(product, result[part].reshape(-1, matrix.shape[0]))

    over_ranges(work, -(-frames // together), smallest=max(1, SMALLEST // (together * rows * points)))
    return result

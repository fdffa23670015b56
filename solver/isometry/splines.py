"""Smoothing thin-plate splines over a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.solver.records import Floats

STIFF = 1e-3
"""Smoothing of the splines, in units of the template's squared standard deviation; needed because the anchors' depths are not exact."""


def spline(source: Floats, values: Floats, target: Floats) -> Floats:
    """Return the smoothing spline of `values (N, k)` at `source (N, 2)`, evaluated at `target (M, 2)`."""
    return np.asarray(spline_basis(target, source) @ spline_coefficients(source, values))


def spline_coefficients(source: Floats, values: Floats) -> Floats:
    """Return the coefficients of a smoothing spline, shape `(N + 3, k)`: of the points, then of 1, x and y."""
    return np.linalg.solve(_equations(source), np.concatenate([values, np.zeros((3, values.shape[1]))]))


def partial_splines(source: Floats, values: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return the coefficients of F splines, shape `(F, N + 3, k)`, each of the values at its known points only.

    Parameters
    ----------
    source : array, shape (N, 2)
        Positions, the same for all splines.
    values : array, shape (F, N, k)
    known : array of bool, shape (F, N)
    """
    frames, count, _ = values.shape
    used = np.concatenate([known, np.ones((frames, 3), dtype=bool)], axis=1)
    equations = np.where(used[:, :, None] & used[:, None, :], _equations(source), np.eye(count + 3))
    wanted = np.concatenate([np.where(known[..., None], values, 0.0), np.zeros((frames, 3, values.shape[2]))], axis=1)
    return np.linalg.solve(equations, wanted)


def _equations(source: Floats) -> Floats:
    """Return the matrix of the equations of the coefficients, shape `(N + 3, N + 3)`."""
    count = len(source)
    affine = np.concatenate([np.ones((count, 1)), source], axis=1)
    matrix = np.zeros((count + 3, count + 3))
    matrix[:count, :count] = _kernel(source, source) + STIFF * np.eye(count)
    matrix[:count, count:], matrix[count:, :count] = affine, affine.T
    matrix[count:, count:] = -1e-9 * np.eye(3)  # collinear sources do not determine the affine part
    return matrix


def spline_basis(target: Floats, source: Floats) -> Floats:
    """Return the values at `target (M, 2)` that the coefficients multiply, shape `(M, N + 3)`."""
    return np.concatenate([_kernel(target, source), np.ones((len(target), 1)), target], axis=1)


def spline_slopes(target: Floats, source: Floats) -> Floats:
    """Return the derivatives of `spline_basis` by x and y, shape `(2, M, N + 3)`."""
    apart = target[:, None] - source
    square = np.maximum(np.square(apart).sum(axis=2), np.finfo(np.float64).tiny)
    inner = (1 + np.log(square)) * apart.transpose(2, 0, 1)
    affine = np.broadcast_to(np.eye(3)[1:, None], (2, len(target), 3))
    return np.concatenate([inner, affine], axis=2)


def _kernel(target: Floats, source: Floats) -> Floats:
    """Return r² log r between all pairs."""
    square = np.square(target[:, None, 0] - source[:, 0]) + np.square(target[:, None, 1] - source[:, 1])
    return np.asarray(0.5 * square * np.log(np.maximum(square, np.finfo(np.float64).tiny)))

"""Points of all frames, and the matrix W of their coordinates."""

from __future__ import annotations

import numpy as np
from pliant.solver.records import Floats


def centred(points: Floats) -> Floats:
    """Return points `(F, P, d)` minus each frame's mean point."""
    return np.asarray(points - points.mean(axis=1, keepdims=True))


def columns(points: Floats) -> Floats:
    """Return points `(F, P, 2)` as a matrix `(2F, P)` with rows x1, y1, x2 and so on."""
    return np.asarray(points.transpose(0, 2, 1).reshape(2 * len(points), -1))


def gram_of(matrix: Floats) -> Floats:
    """Return W Wᵀ / P of a matrix `(2F, P)`, shape `(2F, 2F)`."""
    return np.asarray(matrix @ matrix.T / matrix.shape[1])


def points_of(matrix: Floats) -> Floats:
    """Return the points `(F, P, 2)` of a matrix `(2F, P)`, the inverse of `columns`."""
    return matrix.reshape(-1, 2, matrix.shape[1]).transpose(0, 2, 1)

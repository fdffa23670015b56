"""The low-rank prior: the shapes of all frames are combinations of a few basis shapes.

With G = X Xᵀ / P the F×F Gram matrix of the frames (X as F×3P) and g_i its eigenvalues, the penalty is

    λ3 P Σ_i φ(g_i),    φ(g) = g/δ  for g ≤ δ,   1 + log(g/δ)  above,

a reweighted nuclear norm. φ is concave and smooth, so tr φ(G) lies below its tangent tr φ'(G₀) G + constant, a quadratic
in X with the F×F matrix φ'(G₀). Below the floor δ all modes have the same weight, so this matrix is a multiple of the
identity minus one term per mode above δ. It costs one eigenproblem of size F, and per point one product per such mode.
"""

from __future__ import annotations

import numpy as np
from pliant.solver.operators.normal_equations import RankTerm
from pliant.solver.records import Array, Floats
from scipy import linalg

RANK_FLOOR = 1e-4
"""δ: variance per point, normalized units squared, below which a mode counts as noise."""


def frame_gram(shapes: Array) -> Floats:
    """Return X Xᵀ / P over frames, shape `(F, F)`."""
    flat = shapes.reshape(len(shapes), -1)
    gram: Floats = (flat @ flat.T).astype(np.float64) / shapes.shape[2]
    return gram


def rank_penalty(shapes: Array, weight: float) -> float:
    """Return λ3 P Σ φ(g_i)."""
    if weight == 0:
        return 0.0
    values = np.maximum(linalg.eigvalsh(frame_gram(shapes)), 0.0)
    ratio = values / RANK_FLOOR
    total = float(np.sum(np.where(ratio <= 1, ratio, 1 + np.log(np.maximum(ratio, 1)))))
    return weight * total * int(shapes.shape[2])


def rank_term(shapes: Array, weight: float) -> RankTerm | None:
    """Return the quadratic that touches the penalty at these shapes and majorises it elsewhere; None if `weight` is 0."""
    if weight == 0:
        return None
    values, vectors = linalg.eigh(frame_gram(shapes))
    kept = values > RANK_FLOOR
    level = weight / RANK_FLOOR
    return RankTerm(level, vectors[:, kept], level * (1 - RANK_FLOOR / values[kept]))

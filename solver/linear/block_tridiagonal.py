"""Block-tridiagonal preconditioner: the exact solution over frames for each point, with individual observation weights.

Without the coupling between neighbouring points, 𝒜 is block tridiagonal over frames for each point,

    D_f = s²Rᵀ diag(ω_fp) R + (λ1 [HᵀH]_ff + λ2 [AᵀA]_pp) I,        off-diagonal blocks λ1 [HᵀH]_f,f+1 I,

with 3×3 blocks; the diagonal of the spatial term is kept. Block elimination (Golub and Van Loan, Matrix Computations,
4.5.1) has constant cost per frame and point and stores six numbers for each. IRLS weights of inliers and outliers differ
by two orders of magnitude, so one mean weight per frame, as in the cosine preconditioner, fits neither.
`pliant.solver.linear.multigrid` adds the spatial coupling.
"""

from __future__ import annotations

import numpy as np
from pliant.solver.linear.conjugate_gradient import Linear
from pliant.solver.operators.normal_equations import Operator
from pliant.solver.records import Array, Floats
from pliant.solver.threads import over_ranges

POINTS_PER_BLOCK = 8192
"""Number of points eliminated together, so that one frame of them fits in the processor's cache. Milliseconds per
application on 99 × 29,000 with 2,048, 4,096, 8,192 points: 59, 41, 35 in double precision; 41, 27, 20 in single."""

DIAGONAL_RIDGE = 1e-9
"""Ridge on the diagonal, relative to that of the stencil; without it the system of a point that is never visible is singular."""

ROUNDING = 64.0
"""Least relative ridge in units of machine epsilon; bounds the rounding error of the elimination."""

SINGLE_SPAN = 1e5
"""Ratio of the largest observation weight to the stiffness of a path below which single precision is used."""

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Row and column indices of the six distinct entries of a symmetric 3×3 block."""


def fits(operator: Operator) -> bool:
    """Whether the operator couples only neighbouring frames, so that block elimination applies."""
    return operator.rank is None and len(operator.stencil) == 2 and float(operator.stencil[0].max()) > 0


def stiffness_of_neighbours(operator: Operator) -> Floats:
    """Return λ2 [AᵀA]_pp, shape `(P,)`."""
    points = operator.weights.shape[2]
    if operator.laplacian is None or operator.spatial_weight == 0:
        return np.zeros(points)
    squared = operator.laplacian.matrix.power(2).sum(axis=0)
    return operator.spatial_weight * np.asarray(squared, dtype=np.float64).ravel()


def suits_single_precision(operator: Operator) -> bool:
    """Whether the blocks are well enough conditioned to be inverted in single precision."""
    stiff = float(operator.stencil[0].max()) + float(stiffness_of_neighbours(operator).mean())
    data = float(operator.weights.max()) * float((operator.projections**2).sum(axis=(1, 2)).max())
    return data < SINGLE_SPAN * stiff


def build(operator: Operator, stiffness: Floats | None = None) -> Linear:
    """Factor the preconditioner for one reweighting and return r ↦ M⁻¹ r.

    `stiffness` is the diagonal of the spatial term, shape `(P,)`; it defaults to the operator's own.
    """
    stiffness = stiffness_of_neighbours(operator) if stiffness is None else stiffness
    kind = operator.weights.dtype
    inverses = np.zeros((len(operator.projections), 6, operator.weights.shape[2]), dtype=kind)
    ridge = max(DIAGONAL_RIDGE, ROUNDING * float(np.finfo(kind).eps)) * operator.stencil[0].max()
    shift = (stiffness + ridge).astype(kind)
    coupling = operator.stencil[1].astype(kind)

    def eliminate(start: int, stop: int) -> None:
        for first, last in _blocks(start, stop):
            _eliminate(operator, shift[first:last], coupling, inverses[:, :, first:last], slice(first, last))

    over_ranges(eliminate, inverses.shape[2], smallest=POINTS_PER_BLOCK // 2)

    def apply(r: Array, /, out: Array | None = None) -> Array:
        result = np.empty_like(r) if out is None else out

        def substitute(start: int, stop: int) -> None:
            for first, last in _blocks(start, stop):
                _substitute(inverses[:, :, first:last], coupling, r[:, :, first:last], result[:, :, first:last])

        over_ranges(substitute, r.shape[2], smallest=POINTS_PER_BLOCK // 2)
        return result

    return apply


def _blocks(start: int, stop: int) -> list[tuple[int, int]]:
    return [(first, min(first + POINTS_PER_BLOCK, stop)) for first in range(start, stop, POINTS_PER_BLOCK)]


def _eliminate(operator: Operator, shift: Array, coupling: Array, inverses: Array, points: slice) -> None:
    """Fill `inverses` with D̃_f⁻¹, where D̃_0 = D_0 and D̃_f = D_f − c² D̃_{f−1}⁻¹."""
    first, second = np.array(PAIRS).T
    products = operator.projections[:, :, first] * operator.projections[:, :, second]  # (F, 2, 6)
    block, spare = np.empty_like(inverses[0]), np.empty_like(inverses[0])
    for frame, seen in enumerate(products):
        one, two = operator.weights[frame, :, points]
        np.multiply(seen[0, :, None], one, out=block)
        np.multiply(seen[1, :, None], two, out=spare)
        block += spare
        block[[0, 3, 5]] += shift + shift.dtype.type(operator.stencil[0, frame])
        if frame > 0:
            np.multiply(inverses[frame - 1], coupling[frame - 1] ** 2, out=spare)
            block -= spare
        _invert(block, inverses[frame])


def _invert(block: Array, out: Array) -> None:
    """Invert symmetric 3×3 blocks by cofactors, shape `(6, P)`."""
    a, b, c, d, e, f = block
    out[0], out[1], out[2] = d * f - e * e, c * e - b * f, b * e - c * d
    scale = a * out[0] + b * out[1] + c * out[2]
    out[3], out[4], out[5] = a * f - c * c, b * c - a * e, a * d - b * b
    out /= scale


def _substitute(inverses: Array, coupling: Array, r: Array, out: Array) -> None:
    """Substitute forward, z_f = D̃_f⁻¹ (r_f − c z_{f−1}), then backward, z_f −= c D̃_f⁻¹ z_{f+1}."""
    right, product, spare = (np.empty_like(r[0]) for _ in range(3))
    for frame in range(len(r)):
        if frame == 0:
            _product(inverses[0], r[0], out[0], spare)
            continue
        np.multiply(out[frame - 1], -coupling[frame - 1], out=right)
        right += r[frame]
        _product(inverses[frame], right, out[frame], spare)
    for frame in range(len(r) - 2, -1, -1):
        _product(inverses[frame], out[frame + 1], product, spare)
        product *= coupling[frame]
        out[frame] -= product


def _product(block: Array, x: Array, out: Array, spare: Array) -> None:
    """Multiply symmetric 3×3 blocks, `(6, P)`, by vectors, `(3, P)`, without allocating."""
    np.multiply(block[:3], x[0], out=out)  # first column: a, b, c
    np.multiply(block[1], x[1], out=spare[0])
    np.multiply(block[3:5], x[1], out=spare[1:])
    out += spare  # second column: b, d, e
    np.multiply(block[2], x[2], out=spare[0])
    np.multiply(block[4:6], x[2], out=spare[1:])
    out += spare  # third column: c, e, f

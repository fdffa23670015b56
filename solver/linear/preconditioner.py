"""Choice of the preconditioner.

If frames are coupled to their neighbours only, the equations over frames are inverted for each point (`linear.points`),
and coarser levels are added if the spatial term matters (`linear.multigrid`); the cost is linear in frames and points.
Otherwise (rank term, second differences or no temporal smoothness) each frame gets one mean weight. 𝒜 then is the
Sylvester operator X ↦ T X + λ2 X K, with T the 3F×3F temporal part, diagonalised once per reweighting, and K = AᵀA over
points, nearly diagonal in the cosine basis of a grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver.linear import block_tridiagonal, multigrid, points
from pliant.solver.linear.conjugate_gradient import Linear
from pliant.solver.operators.normal_equations import Operator
from pliant.solver.pulse import pulse
from pliant.solver.records import Array, Floats, Ints
from pliant.solver.threads import available_cores, over_ranges
from scipy import fft, linalg

MIN_POINTS_PER_THREAD = 1024
"""Minimum number of points per thread."""
BENDS = 1.0
"""Ratio of the spatial term to the temporal stiffness of slow motion above which coarser levels are added."""


def temporal_matrix(operator: Operator) -> Floats:
    """Return T, dense `(3F, 3F)`: data term with mean weights per frame, stencil over frames, rank term.

    A Gaussian prior has no other part here: with a weight above 0, its equations are inverted for each point.
    """
    frames = len(operator.projections)
    cameras = operator.projections.astype(np.float64)
    mean = operator.weights.mean(axis=2, dtype=np.float64)
    blocks = np.einsum("fic,fi,fid->fcd", cameras, mean, cameras)
    over_frames = np.zeros((frames, frames))
    for k, band in enumerate(operator.bands):
        index = np.arange(frames - k)
        over_frames[index, index + k] = over_frames[index + k, index] = band[: frames - k]
    if operator.rank is not None:
        over_frames += operator.rank.matrix()
    whole = np.kron(over_frames, np.eye(3)).reshape(frames, 3, frames, 3)
    index = np.arange(frames)
    whole[index, :, index, :] += blocks
    return np.asarray(whole.reshape(3 * frames, 3 * frames), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Diagonalised:
    """Eigendecomposition T = V diag(values) Vᵀ."""

    vectors: Array
    values: Floats

    @classmethod
    def of(cls, operator: Operator, kind: np.dtype[np.floating]) -> Diagonalised:
        """Diagonalise the temporal part; null directions get a tiny positive eigenvalue."""
        values, vectors = linalg.eigh(temporal_matrix(operator))
        return cls(vectors.astype(kind), np.maximum(values, 1e-10 * values[-1]))


def build_preconditioner(operator: Operator) -> Linear:
    """Return M⁻¹ for this reweighting's operator."""
    if not block_tridiagonal.fits(operator):
        return _alike(operator)
    build = multigrid.build if bends(operator) else points.build
    # Without a Gaussian prior some directions are unconstrained; the larger ridge of single precision would constrain them.
    if operator.quadratic is None or not block_tridiagonal.suits_single_precision(operator):
        return build(operator)
    return _in_single_precision(build(operator.rounded(np.dtype(np.float32))))


def _in_single_precision(inverse: Linear) -> Linear:
    """Wrap a single-precision inverse for residuals of any precision: few digits suffice, at half the memory traffic."""
    spare: list[Array] = []  # allocated once: touching new memory takes as long as the conversion

    def apply(r: Array, /, out: Array | None = None) -> Array:
        result = np.empty_like(r) if out is None else out
        if not spare:
            spare.extend(np.empty_like(r, dtype=np.float32) for _ in range(2))
        rounded, found = spare
        pulse()
        np.copyto(rounded, r, casting="same_kind")
        solved = inverse(rounded, out=found)
        pulse()
        result[...] = solved
        return result

    return apply


def bends(operator: Operator) -> bool:
    """Whether the spatial term matters compared with the temporal stiffness of slow motion, about λ1/F²."""
    if operator.laplacian is None or operator.spatial_weight == 0:
        return False
    slow = float(operator.stencil[0].max()) / len(operator.projections) ** 2
    return float(block_tridiagonal.stiffness_of_neighbours(operator).mean()) > BENDS * slow


def _alike(operator: Operator) -> Linear:
    """Return the inverse with one mean weight per frame."""
    kind = operator.weights.dtype
    laplacian = operator.laplacian
    if laplacian is None or operator.spatial_weight == 0:
        return _by_inverse(temporal_matrix(operator), kind)
    temporal = Diagonalised.of(operator, kind)
    if laplacian.grid is not None:
        return lambda r, out=None: _by_cosines(r, temporal, laplacian.grid, operator.spatial_weight)  # noqa: ARG005
    diagonal = block_tridiagonal.stiffness_of_neighbours(operator)
    return lambda r, out=None: _by_point(r, temporal, diagonal)  # noqa: ARG005


def _by_inverse(temporal: Floats, kind: np.dtype[np.floating]) -> Linear:
    """Return r ↦ T⁻¹ r for every point, by one product with a dense T⁻¹."""
    size = len(temporal)
    temporal[np.diag_indices(size)] += 1e-12 * temporal.diagonal().max()
    inverse = linalg.cho_solve(linalg.cho_factor(temporal, lower=True), np.eye(size))
    symmetric = ((inverse + inverse.T) / 2).astype(kind)

    def apply(x: Array, /, out: Array | None = None) -> Array:
        result = np.zeros_like(x) if out is None else out
        flat, into = x.reshape(size, -1), result.reshape(size, -1)

        def work(start: int, stop: int) -> None:
            into[:, start:stop] = symmetric @ flat[:, start:stop]

        over_ranges(work, flat.shape[1], smallest=MIN_POINTS_PER_THREAD)
        return result

    return apply


def _by_point(r: Array, temporal: Diagonalised, shift: Floats) -> Array:
    """Solve (T + shift_p I) x_p = r_p for every point p."""
    flat = r.reshape(len(temporal.values), -1)
    result = np.zeros_like(flat)
    shifts = np.broadcast_to(shift, flat.shape[1])

    def work(start: int, stop: int) -> None:
        inner = temporal.vectors.T @ flat[:, start:stop]
        inner /= (temporal.values[:, None] + shifts[start:stop]).astype(r.dtype)
        result[:, start:stop] = temporal.vectors @ inner

    over_ranges(work, flat.shape[1], smallest=MIN_POINTS_PER_THREAD)
    return result.reshape(r.shape)


def _by_cosines(r: Array, temporal: Diagonalised, grid: Ints, weight: float) -> Array:
    """Solve T X + λ2 X K = R on the bounding grid with reflecting borders, where cosines diagonalise K."""
    height, width = grid.shape
    filled = grid >= 0
    inner = temporal.vectors.T @ r.reshape(len(temporal.values), -1)
    image = np.zeros((len(inner), height, width), dtype=r.dtype)
    image[:, filled] = inner[:, grid[filled]]
    image = fft.dctn(image, axes=(1, 2), norm="ortho", workers=available_cores(), overwrite_x=True)
    shift = weight * stencil_symbol(height, width) ** 2
    image /= (temporal.values[:, None, None] + shift).astype(r.dtype)
    image = fft.idctn(image, axes=(1, 2), norm="ortho", workers=available_cores(), overwrite_x=True)
    inner[:, grid[filled]] = image[:, filled]
    return (temporal.vectors @ inner).reshape(r.shape)


def stencil_symbol(height: int, width: int) -> Floats:
    """Return the eigenvalues, all ≤ 0, of the 8-neighbour stencil with reflecting borders, shape `(height, width)`."""
    down = np.cos(np.pi * np.arange(height) / height)[:, None]
    right = np.cos(np.pi * np.arange(width) / width)[None, :]
    symbol: Floats = 2 * down + 2 * right + 4 * down * right - 8
    return symbol

"""A random walk of a point's position, given its images: means, variances and determinants in time linear in the frames.

The walk x ∈ R^{3F} has covariance τ (T ⊗ I₃), T⁻¹ = n (HᵀH + 10/F² I) with H the first difference over frames and n such that the mean
of T's diagonal is 1; its images are w = B x + N(0, σ² I), B = blockdiag(B_f) of 2×3. All results follow from the precision of x given w,

    Λ = T⁻¹/τ ⊗ I₃ + BᵀB/σ²,

block tridiagonal with 3×3 blocks. With D = σ²I + τ B (T ⊗ I₃) Bᵀ, the covariance of w, Woodbury's identity and the matrix determinant lemma
give D⁻¹ = (I − B Λ⁻¹ Bᵀ/σ²)/σ² and log det D = 2F log σ² + log det Λ + log det τT ⊗ I₃. Golub and Van Loan, Matrix Computations,
2.1.4 and 4.5.1.

Photographs in no order have no walk: with `ordered` False, T is the identity, and each frame deviates independently.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pliant.solver.operators.finite_differences import difference_bands
from pliant.solver.records import Floats, read_only
from scipy.linalg import lapack, solveh_banded

FRAMES_PER_BLOCK = 8
"""Frames eliminated together, as one dense block: of 4, 8 and 12 the fastest for 120 to 1,000 frames and 90 to 350 columns."""

LEVEL = 10.0
"""Precision of the walk's mean level, as a multiple of n/F²: it keeps T⁻¹ invertible and hardly constrains the level."""


@lru_cache(maxsize=32)
def walk_bands(num_frames: int, ordered: bool) -> tuple[Floats, float]:
    """Return the upper bands of HᵀH + 10/F² I, shape `(2, F)`, and n, the mean of its inverse's diagonal.

    If unordered, return those of the identity, and 1.
    """
    bands = np.zeros((2, num_frames))
    if not ordered:
        bands[0] = 1.0
        read_only(bands)
        return bands, 1.0
    differences = difference_bands(num_frames, 1)
    bands[: len(differences)] = differences
    bands[0] += LEVEL / num_frames**2
    # The bands of the inverse of a tridiagonal matrix: forward and backward pivots meet at each frame.
    ahead, back = _pivots(bands[0], bands[1]), _pivots(bands[0][::-1], bands[1, :-1][::-1])[::-1]
    norm = float(np.mean(1 / (ahead + back - bands[0])))
    read_only(bands)
    return bands, norm


def _pivots(diagonal: Floats, beside: Floats) -> Floats:
    """Return the pivots of Gaussian elimination of a symmetric tridiagonal matrix, shape `(F,)`."""
    pivots = diagonal.copy()
    for index in range(1, len(diagonal)):
        pivots[index] -= beside[index - 1] ** 2 / pivots[index - 1]
    return pivots


@lru_cache(maxsize=8)
def random_walk(num_frames: int, ordered: bool) -> Floats:
    """Return T, the covariance of the random walk, mean of the diagonal 1, shape `(F, F)`; read-only."""
    inverse, norm = walk_precision(num_frames, ordered)
    walk = np.asarray(np.linalg.inv(inverse) / norm, dtype=np.float64)
    read_only(walk)
    return walk


def random_walk_at(used: NDArray[np.intp], num_frames: int, ordered: bool) -> Floats:
    """Return T restricted to the frames used, shape `(F', F')`, in time and memory linear in F."""
    columns = np.zeros((num_frames, len(used)))
    columns[used, np.arange(len(used))] = 1.0
    return walked(columns, ordered)[used]


def walked(columns: Floats, ordered: bool) -> Floats:
    """Return T times columns of shape `(F, k)`, in time and memory linear in F."""
    bands, norm = walk_bands(len(columns), ordered)
    return np.asarray(solveh_banded(np.stack([np.append(0.0, bands[1, :-1]), bands[0]]), columns / norm))


@lru_cache(maxsize=8)
def whitener(num_frames: int, ordered: bool) -> Floats:
    """Return the lower triangular root with T⁻¹ = root rootᵀ, shape `(F, F)`; read-only."""
    inverse, norm = walk_precision(num_frames, ordered)
    root = np.asarray(np.linalg.cholesky(inverse * norm), dtype=np.float64)
    read_only(root)
    return root


@lru_cache(maxsize=32)
def whitener_bands(num_frames: int) -> Floats:
    """Return the lower bands of the root in `whitener`, shape `(2, F)`; read-only."""
    bands, norm = walk_bands(num_frames, ordered=True)
    root: Floats = lapack.dpbtrf(bands * norm, lower=1)[0]
    read_only(root)
    return root


def whitened(columns: Floats, *, ordered: bool) -> Floats:
    """Return rootᵀ times columns of shape `(F, k)`: in these coordinates the walk is white."""
    if not ordered:
        return columns
    bands = whitener_bands(len(columns))
    result: Floats = bands[0][:, None] * columns
    result[:-1] += bands[1, :-1, None] * columns[1:]
    return result


def coloured(columns: Floats, *, ordered: bool, transposed: bool = False) -> Floats:
    """Return root⁻ᵀ times columns of shape `(F, k)`, the inverse of `whitened`; if `transposed`, root⁻¹ times the columns."""
    if not ordered or columns.shape[1] == 0:  # LAPACK writes beyond an array without columns
        return columns
    bands = whitener_bands(len(columns))
    return np.asarray(lapack.dtbtrs(bands, columns, uplo="L", trans="N" if transposed else "T")[0])


@lru_cache(maxsize=32)
def log_det_walk(num_frames: int, ordered: bool) -> float:
    """Return log det T."""
    bands, norm = walk_bands(num_frames, ordered)
    return -num_frames * float(np.log(norm)) - float(np.log(_pivots(bands[0], bands[1])).sum())


def walk_precision(num_frames: int, ordered: bool) -> tuple[Floats, float]:
    """Return HᵀH + 10/F² I, shape `(F, F)`, and n."""
    bands, norm = walk_bands(num_frames, ordered)
    return np.diag(bands[0]) + np.diag(bands[1, :-1], 1) + np.diag(bands[1, :-1], -1), norm


@dataclass(frozen=True, slots=True, eq=False)
class WalkPosterior:
    """Block elimination of Λ."""

    inverses: Floats
    """Inverses of the pivot blocks, shape `(N, 3b, 3b)`, b = `FRAMES_PER_BLOCK`; the last is padded with the identity."""

    coupling: float
    """Entry of −Λ between neighbouring frames, equal for every axis."""

    variances: Floats
    """Diagonal blocks of Λ⁻¹, shape `(F, 3, 3)`."""

    log_det: float
    """log det Λ + log det τT ⊗ I₃."""

    @classmethod
    def of(cls, images: Floats, *, noise_variance: float, walk_variance: float, ordered: bool) -> WalkPosterior:
        """Factor Λ for B_f of shape `(F, 2, 3)`, σ² and τ.

        Raises
        ------
        numpy.linalg.LinAlgError
            Λ is indefinite to rounding, or not finite.
        """
        frames = len(images)
        bands, norm = walk_bands(frames, ordered)
        coupling = -norm * float(bands[1, 0]) / walk_variance if frames > 1 else 0.0
        blocks = np.einsum("fic,fid->fcd", images, images) / noise_variance
        blocks += (bands[0] * norm / walk_variance)[:, None, None] * np.eye(3)
        ahead, log_det = _block_pivots(blocks, coupling)
        back, _ = _block_pivots(blocks[::-1], coupling)
        variances = np.linalg.inv(ahead + back[::-1] - blocks)
        log_det += 3 * (frames * float(np.log(walk_variance)) + log_det_walk(frames, ordered))
        return cls(_gathered(blocks, ahead, coupling), coupling, variances, log_det)

    def solve(self, columns: Floats) -> Floats:
        """Return Λ⁻¹ times columns of shape `(F, 3, r)`, in the same shape."""
        frames, _, count = columns.shape
        blocks = len(self.inverses)
        padded = np.zeros((blocks * FRAMES_PER_BLOCK, 3, count))
        padded[:frames] = columns
        result = self.inverses @ padded.reshape(blocks, 3 * FRAMES_PER_BLOCK, count)
        before = np.zeros((blocks, 3, count))
        corner = self.coupling * self.inverses[:, -3:, :3]
        for index in range(1, blocks):
            before[index] = result[index - 1, -3:] + corner[index - 1] @ before[index - 1]
        result += (self.coupling * self.inverses[:, :, :3]) @ before
        after = np.zeros((blocks, 3, count))
        corner = self.coupling * self.inverses[:, :3, -3:]
        for index in range(blocks - 2, -1, -1):
            after[index] = result[index + 1, :3] + corner[index + 1] @ after[index + 1]
        result += (self.coupling * self.inverses[:, :, -3:]) @ after
        return result.reshape(len(padded), 3, count)[:frames]


def _block_pivots(blocks: Floats, coupling: float) -> tuple[Floats, float]:
    """Return the 3×3 pivots of block elimination, shape `(F, 3, 3)`, and the log-determinant, by a banded Cholesky factor."""
    frames = len(blocks)
    bands = np.zeros((4, 3 * frames))
    for below in range(3):
        for column in range(3 - below):
            bands[below, column::3] = blocks[:, column + below, column]
    bands[3, :-3] = -coupling
    factor, failed = lapack.dpbtrf(bands, lower=1)
    if failed or not np.isfinite(factor[0]).all():
        raise np.linalg.LinAlgError("the precision of the random walk is not positive definite")
    roots = np.zeros((frames, 3, 3))
    for below in range(3):
        for column in range(3 - below):
            roots[:, column + below, column] = factor[below, column::3]
    return roots @ roots.transpose(0, 2, 1), 2 * float(np.log(factor[0]).sum())


def _gathered(blocks: Floats, pivots: Floats, coupling: float) -> Floats:
    """Return the inverses of the pivots of `FRAMES_PER_BLOCK` frames, `(N, 3·FRAMES_PER_BLOCK, 3·FRAMES_PER_BLOCK)`."""
    frames = len(blocks)
    count = -(-frames // FRAMES_PER_BLOCK)
    padded = np.broadcast_to(np.eye(3), (count * FRAMES_PER_BLOCK, 3, 3)).copy()
    padded[:frames] = blocks
    padded[:frames:FRAMES_PER_BLOCK] = pivots[::FRAMES_PER_BLOCK]
    gathered = np.zeros((count, FRAMES_PER_BLOCK, 3, FRAMES_PER_BLOCK, 3))
    each = np.arange(FRAMES_PER_BLOCK)
    gathered[:, each, :, each, :] = padded.reshape(count, FRAMES_PER_BLOCK, 3, 3).transpose(1, 0, 2, 3)
    coupled = np.where(
        np.arange(count * FRAMES_PER_BLOCK).reshape(count, FRAMES_PER_BLOCK) + 1 < frames, -coupling, 0.0
    )[:, :-1]
    for axis in range(3):
        gathered[:, each[:-1], axis, each[1:], axis] = coupled
        gathered[:, each[1:], axis, each[:-1], axis] = coupled
    return np.asarray(
        np.linalg.inv(gathered.reshape(count, 3 * FRAMES_PER_BLOCK, 3 * FRAMES_PER_BLOCK)), dtype=np.float64
    )

"""Precision matrix of the Gaussian prior over frames: tridiagonal minus a few modes, so that products are linear in F.

For each coordinate c the covariance over frames is C_c = B⁻¹ + U_c U_cᵀ: a random walk, whose inverse B is tridiagonal, plus modes. By
Woodbury's identity (Golub and Van Loan, Matrix Computations, 2.1.4)

    C_c⁻¹ = B − V_c V_cᵀ,    V_c = B U_c K⁻ᵀ,    K Kᵀ = I + U_cᵀ B U_c,

which stores two numbers per frame and one column per mode instead of F² numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pliant.solver.records import Array, Floats
from pliant.solver.threads import SMALLEST, over_ranges
from scipy import linalg

POINT_BLOCK = 1024
"""Number of points per unit of parallel work."""


@dataclass(frozen=True, slots=True, eq=False)
class PathPrior:
    """Precision matrices Q_c = B − V_c V_cᵀ over frames, one per coordinate c."""

    bands: Floats
    """Upper bands of B, shape `(2, F)`: the diagonal, then the coupling of frames f and f + 1 (0 at the end)."""

    modes: tuple[Array, Array, Array]
    """V_c of each coordinate, shape `(F, m_c)`."""

    @classmethod
    def of(cls, bands: Floats, roots: tuple[Floats, Floats, Floats]) -> PathPrior:
        """Build Q_c from B and the roots U_c of the covariances B⁻¹ + U_c U_cᵀ."""
        modes = []
        for root in roots:
            pushed = _chained(bands, root)
            factor = np.linalg.cholesky(np.eye(root.shape[1]) + root.T @ pushed)
            modes.append(np.ascontiguousarray(linalg.solve_triangular(factor, pushed.T, lower=True).T))
        return cls(bands, (modes[0], modes[1], modes[2]))

    def scaled(self, factor: float) -> PathPrior:
        """Return Q_c times a nonnegative factor."""
        first, second, third = (factor**0.5 * each for each in self.modes)
        return PathPrior(factor * self.bands, (first, second, third))

    def rounded(self, kind: np.dtype[np.floating]) -> PathPrior:
        """Return Q_c with the modes in another precision."""
        first, second, third = (each.astype(kind) for each in self.modes)
        return PathPrior(self.bands, (first, second, third))

    def subtract_modes(self, shapes: Array, result: Array) -> None:
        """Subtract V_c V_cᵀ X_c from each coordinate c of the result; the operator's stencil applies B."""

        def work(span: slice) -> None:
            for axis, modes in enumerate(self.modes):
                result[:, axis, span] -= modes @ (modes.T @ shapes[:, axis, span])

        over_blocks(work, shapes.shape[2], rows=3 * len(shapes))

    def value(self, shapes: Array) -> float:
        """Return Σ_c tr X_cᵀ Q_c X_c in double precision, as it is a small difference of large numbers for smooth paths."""
        parts = np.zeros(-(-shapes.shape[2] // POINT_BLOCK))
        diagonal, beside = self.bands[0], self.bands[1, :-1]
        modes = [each.astype(np.float64) for each in self.modes]

        def work(span: slice) -> None:
            total = 0.0
            for axis, along in enumerate(modes):
                paths = shapes[:, axis, span].astype(np.float64)
                seen = along.T @ paths
                total += float(np.einsum("f,fp,fp->", diagonal, paths, paths))
                total += 2 * float(np.einsum("f,fp,fp->", beside, paths[:-1], paths[1:]))
                total -= float(np.einsum("kp,kp->", seen, seen))
            parts[span.start // POINT_BLOCK] = total

        over_blocks(work, shapes.shape[2], rows=3 * len(shapes))
        return float(parts.sum())

    def loosest(self, count: int) -> list[tuple[Floats, Floats]]:
        """Return, for each coordinate, the directions of least precision under Q_c, `(F, k)`, and their precisions, `(k,)`.

        Rayleigh–Ritz in the span of U_c = B⁻¹ V_c Kᵀ, which contains all directions with much more variance than the random walk.
        """
        found = []
        banded = np.stack([self.bands[0], self.bands[1]])[::-1].copy()
        banded[0] = np.roll(banded[0], 1)  # SciPy's layout of upper bands
        for each in self.modes:
            along = each.astype(np.float64)
            span, _ = np.linalg.qr(linalg.solveh_banded(banded, along))
            seen = along.T @ span
            held, turn = np.linalg.eigh(span.T @ _chained(self.bands, span) - seen.T @ seen)
            found.append((span @ turn[:, :count], held[:count]))
        return found


def over_blocks(work: Callable[[slice], None], points: int, *, rows: int) -> None:
    """Call `work` on blocks of points; the blocks do not depend on the number of threads."""

    def blocks(start: int, stop: int) -> None:
        for first in range(start * POINT_BLOCK, min(stop * POINT_BLOCK, points), POINT_BLOCK):
            work(slice(first, min(first + POINT_BLOCK, points)))

    over_ranges(blocks, -(-points // POINT_BLOCK), smallest=max(1, SMALLEST // (rows * POINT_BLOCK)))


def _chained(bands: Floats, columns: Floats) -> Floats:
    """Return B times columns of shape `(F, k)`."""
    result = bands[0][:, None] * columns
    result[:-1] += bands[1, :-1, None] * columns[1:]
    result[1:] += bands[1, :-1, None] * columns[:-1]
    return np.asarray(result)

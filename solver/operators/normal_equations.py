"""The normal equations of one reweighting, as a matrix-free operator.

For shapes X of layout `(F, 3, P)` the operator is

    𝒜 X = s² Rᵀ(ω ∘ (R X))  +  λ1 (HᵀH) X  +  λ2 X (AᵀA)  +  Q X

with a 2×3 projection per frame, a stencil over frames, a sparse product over points, and the F×F matrix Q of the
low-rank prior, stored as a multiple of the identity minus a few modes. A Gaussian prior has its own stencil and modes.
The weights ω appear both in 𝒜 and in the right-hand side (the paper's printed eq. 9 has them in 𝒜 only).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.operators.bending import add_bending, frames_together
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.operators.mesh_laplacian import Laplacian
from pliant.solver.records import Array, Floats
from pliant.solver.threads import SMALLEST, over_ranges


@dataclass(frozen=True, slots=True, eq=False)
class RankTerm:
    """Quadratic that majorises the low-rank prior: Q = level · I − U diag(drop) Uᵀ over frames."""

    level: float
    """Weight of all directions outside the modes, including λ3."""

    modes: Floats
    """U, with orthonormal columns, shape `(F, k)`."""

    drop: Floats
    """Difference between `level` and the weight of each mode, shape `(k,)`, in [0, level)."""

    def matrix(self) -> Floats:
        """Return Q as a dense matrix, shape `(F, F)`."""
        return self.level * np.eye(len(self.modes)) - (self.modes * self.drop) @ self.modes.T


@dataclass(frozen=True, slots=True, eq=False)
class Operator:
    """The operator 𝒜; `weights` and `rank` change with every reweighting."""

    projections: Array
    """s_f times the first two rows of R_f, shape `(F, 2, 3)`."""

    weights: Array
    """ω of every coordinate, including the confidence, shape `(F, 2, P)`."""

    bands: Floats
    """λ1 times the upper bands of HᵀH, shape `(order + 1, F)`."""

    laplacian: Laplacian | None
    spatial_weight: float
    """λ2."""

    rank: RankTerm | None = None

    quadratic: PathPrior | None = None
    """The Gaussian prior over frames of each coordinate; its stencil replaces `bands`."""

    @property
    def stencil(self) -> Floats:
        """Upper bands of the prior in use over frames, shape `(order + 1, F)`."""
        return self.bands if self.quadratic is None else self.quadratic.bands

    def apply(self, shapes: Array, /, out: Array | None = None) -> Array:
        """Return 𝒜 X, shape `(F, 3, P)`, in `out` if it is given."""
        return self._apply(shapes, None, np.empty_like(shapes) if out is None else out)

    def gradient(self, shapes: Array, target: Array) -> Array:
        """Return 𝒜 X − b for centred tracks W of shape `(F, 2, P)`: half the gradient of the majorised energy."""
        return self._apply(shapes, target, np.empty_like(shapes))

    def _apply(self, shapes: Array, target: Array | None, result: Array) -> Array:
        together = frames_together(len(shapes))

        def work(start: int, stop: int) -> None:
            image, spare = np.empty_like(shapes[0, :2]), np.empty_like(shapes[0])
            for low in range(start * together, min(stop * together, len(shapes)), together):
                high = min(low + together, len(shapes))
                for frame in range(low, high):
                    camera, row = self.projections[frame], result[frame]
                    np.matmul(camera, shapes[frame], out=image)
                    if target is not None:
                        image -= target[frame]
                    image *= self.weights[frame]
                    np.matmul(camera.T, image, out=row)
                    self._add_temporal(shapes, frame, row, spare)
                if self.laplacian is not None and self.spatial_weight > 0:
                    add_bending(
                        self.laplacian, self.spatial_weight, rows_of(shapes[low:high]), rows_of(result[low:high])
                    )

        over_ranges(work, -(-len(shapes) // together), smallest=max(1, SMALLEST // (together * shapes[0].size)))
        if self.rank is not None:
            self._add_rank(shapes, result)
        if self.quadratic is not None:
            self.quadratic.subtract_modes(shapes, result)
        return result

    def rounded(self, kind: np.dtype[np.floating]) -> Operator:
        """Return the operator in another precision."""
        return replace(
            self,
            projections=self.projections.astype(kind),
            weights=self.weights.astype(kind, copy=False),
            laplacian=None if self.laplacian is None else self.laplacian.rounded(kind),
            quadratic=None if self.quadratic is None else self.quadratic.rounded(kind),
        )

    def _add_temporal(self, shapes: Array, frame: int, out: Array, spare: Array) -> None:
        kind, bands = shapes.dtype.type, self.stencil
        for k in range(len(bands)):
            for neighbour, first in ((frame + k, frame), (frame - k, frame - k))[: 1 if k == 0 else 2]:
                if 0 <= neighbour < len(shapes) and bands[k, first] != 0:
                    np.multiply(shapes[neighbour], kind(bands[k, first]), out=spare)
                    out += spare

    def _add_rank(self, shapes: Array, result: Array) -> None:
        assert self.rank is not None
        flat, out = shapes.reshape(len(shapes), -1), result.reshape(len(shapes), -1)
        modes = self.rank.modes.astype(shapes.dtype)
        parts = modes.T @ flat
        parts *= -self.rank.drop.astype(shapes.dtype)[:, None]
        out += shapes.dtype.type(self.rank.level) * flat
        out += modes @ parts

    def right_hand_side(self, target: Array) -> Array:
        """Return s Rᵀ (ω ∘ W) for centred tracks W of shape `(F, 2, P)`."""
        frames, _, points = target.shape
        back = np.zeros((frames, 3, points), dtype=target.dtype)

        def work(start: int, stop: int) -> None:
            for frame in range(start, stop):
                np.matmul(self.projections[frame].T, self.weights[frame] * target[frame], out=back[frame])

        over_ranges(work, frames, smallest=max(1, SMALLEST // (3 * points)))
        return back


def rows_of(shapes: Array) -> Array:
    """Return a view of the shapes with frames and coordinates as rows, shape `(3F, P)`."""
    return shapes.reshape(-1, shapes.shape[2])

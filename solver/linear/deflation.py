"""Coarse-space correction for points whose weights differ from the mean of their frame: few modes, individual weights.

A preconditioner with one weight per frame treats all points as equally visible. Only the prior determines a hidden or
down-weighted point, and the Gaussian prior is weak along modes of large variance. Along these modes the mean weights are
wrong by orders of magnitude, which slows down conjugate gradients. There are only a few such modes, so on their span U
(F×m per coordinate) the equations are solved exactly for each point,

    N_p = Σ_fi ω_fip u_fi u_fiᵀ + λ1 UᵀQU,    u_fi = U_fᵀ R_fiᵀ,

and the solution is added to that with mean weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.operators.normal_equations import Operator
from pliant.solver.records import Array, Floats
from pliant.solver.threads import over_ranges

MAX_FREE_MODES = 12
"""Maximum number of modes per coordinate; memory is quadratic in it."""

HELD = 0.05
"""Ratio of the prior's precision to the mean weight below which a mode belongs to the coarse space."""

UNLIKE = 0.1
"""Ratio of a weight to its frame's mean below which the weight counts as deviating."""

ENOUGH = 0.002
"""Share of deviating weights below which no correction is built."""

MODE_BLOCK = 256
"""Number of points inverted together."""


@dataclass(frozen=True, slots=True, eq=False)
class Coarse:
    """Coarse space U and the inverses N_p⁻¹."""

    modes: tuple[Floats, Floats, Floats]
    """U of each coordinate c, shape `(F, m_c)`."""

    points: NDArray[np.intp]
    """Indices of the points with deviating weights, shape `(D,)`."""

    inverses: Array
    """N_p⁻¹ of these points, shape `(D, m, m)` with m = Σ m_c."""

    def add(self, r: Array, out: Array) -> None:
        """Add U N⁻¹ Uᵀ r to `out`, both of shape `(F, 3, P)`."""
        modes = [each.astype(r.dtype) for each in self.modes]
        cuts = np.cumsum([0] + [each.shape[1] for each in modes])

        def work(start: int, stop: int) -> None:
            chosen = self.points[start:stop]
            inner = np.concatenate([modes[c].T @ r[:, c, chosen] for c in range(3)])
            inner = np.matmul(self.inverses[start:stop], np.ascontiguousarray(inner.T)[:, :, None])[:, :, 0]
            for c in range(3):
                out[:, c, chosen] += modes[c] @ inner[:, cuts[c] : cuts[c + 1]].T

        over_ranges(work, len(self.points), smallest=256)


def build_coarse(operator: Operator, stiffness: Floats) -> Coarse | None:
    """Return the correction for this reweighting, or None if the mean weights are accurate enough.

    `stiffness` is the diagonal of the spatial term, shape `(P,)`.
    """
    if operator.quadratic is None:
        return None
    mean = operator.weights.mean(axis=2, dtype=np.float64)
    unlike = operator.weights < UNLIKE * mean[:, :, None]
    if float(unlike.mean()) < ENOUGH:
        return None
    limit = HELD * float(mean.mean()) - float(stiffness.mean())
    modes, held = _free_modes(operator, limit)
    if sum(len(each) for each in held) == 0:
        return None
    seen = _seen(operator, modes)
    size = seen.shape[2]
    upper = np.triu_indices(size)
    products = (seen[:, :, upper[0]] * seen[:, :, upper[1]]).reshape(-1, len(upper[0])).astype(operator.weights.dtype)
    points = np.flatnonzero(unlike.any(axis=(0, 1)))
    inverses = np.zeros((len(points), size, size), dtype=operator.weights.dtype)
    prior = np.diag(np.concatenate(held))

    def work(start: int, stop: int) -> None:
        for low in range(start, stop, MODE_BLOCK):
            high = min(low + MODE_BLOCK, stop)
            flat = operator.weights[:, :, points[low:high]].reshape(-1, high - low).T @ products
            normal = np.zeros((high - low, size, size))
            normal[:, upper[0], upper[1]] = flat
            normal[:, upper[1], upper[0]] = flat
            normal += prior + stiffness[points[low:high], None, None] * np.eye(size)
            inverses[low:high] = np.linalg.inv(normal)

    over_ranges(work, len(points), smallest=MODE_BLOCK)
    return Coarse(modes, points, inverses)


def _free_modes(operator: Operator, limit: float) -> tuple[tuple[Floats, Floats, Floats], list[Floats]]:
    """Return, for each coordinate, the modes with a prior precision below `limit` and their precisions."""
    assert operator.quadratic is not None
    modes, held = [], []
    for directions, values in operator.quadratic.loosest(MAX_FREE_MODES):
        free = values < limit
        modes.append(np.ascontiguousarray(directions[:, free]))
        held.append(np.maximum(values[free], 1e-9 * limit))
    return (modes[0], modes[1], modes[2]), held


def _seen(operator: Operator, modes: tuple[Floats, Floats, Floats]) -> Floats:
    """Return u_fi, the modes projected to the image, shape `(F, 2, m)`."""
    cameras = operator.projections.astype(np.float64)
    return np.concatenate([cameras[:, :, c, None] * modes[c][:, None, :] for c in range(3)], axis=2)

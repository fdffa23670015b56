"""State of the minimisation between reweightings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.operators.normal_equations import RankTerm
from pliant.solver.records import Array, Floats


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Shapes, translations and weights after a number of reweightings."""

    shapes: Array
    """X, shape `(F, 3, P)`, centred per frame."""
    translations: Floats
    """t, relative to the tracks' centroids, shape `(F, 2)`, normalized units."""
    omega: Array
    """IRLS weights for the current residuals, shape `(F, 2, P)`."""
    rank: RankTerm | None
    """Majoriser of the low-rank prior at the current shapes."""
    objective: float
    residual: float
    """Median visible reprojection residual, normalized units."""
    reweighting: int
    iterations: int
    """Conjugate-gradient iterations of the last step."""
    reduction: float
    """Relative residual at which the next inner solve ends."""

    def summary(self) -> State:
        """Return the state without its arrays, for the history."""
        nothing = np.zeros(0)
        return replace(self, shapes=nothing, omega=nothing, rank=None)

"""State of a minimisation after some reweightings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.energy.problem import Array
from pliant.solver.operators.normal_equations import RankTerm
from pliant.solver.records import Floats


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """State of the minimisation after some reweightings."""

    shapes: Array
    """X, shape `(F, 3, P)`, centred per frame."""
    translations: Floats
    """t relative to the tracks' centroids, shape `(F, 2)`."""
    omega: Array
    """IRLS weights of the current residual, shape `(F, 2, P)`."""
    rank: RankTerm | None
    """Majoriser of the low-rank prior at the current shapes."""
    objective: float
    residual: float
    """Median visible reprojection residual, normalized units."""
    reweighting: int
    iterations: int
    """Conjugate-gradient iterations of the last step."""
    reduction: float
    """Factor by which the next inner solve reduces the residual."""

    def summary(self) -> State:
        """Return the numbers without the arrays, for the history."""
        nothing = np.zeros(0)
        return replace(self, shapes=nothing, omega=nothing, rank=None)

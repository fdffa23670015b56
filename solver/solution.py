"""Result of a solve, with its outcome."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from pliant.solver.records import Camera, Choices, Floats, Ints, read_only

if TYPE_CHECKING:
    from pliant.solver.evaluation.trust import Trust


class Outcome(StrEnum):
    """How a solve ended; `sentence` explains each member."""

    CONVERGED = "converged"
    """The objective changed by less than the tolerance."""

    MAX_REWEIGHTINGS = "max_reweightings"
    """The maximum number of reweightings was reached first. The result is usable."""

    REJECTED = "rejected"
    """The last step increased the objective; the shapes are those before it."""

    STOPPED = "stopped"
    """The caller asked for it; the shapes are those of the last finished step."""

    @property
    def sentence(self) -> str:
        """Explanation of the outcome, with advice if the user can improve it."""
        return _SENTENCES[self]


_SENTENCES = {
    Outcome.CONVERGED: "Converged.",
    Outcome.MAX_REWEIGHTINGS: (
        "Stopped at the maximum number of reweightings before the objective converged. The result is usable; "
        "raise max_reweightings or tolerance if it must converge."
    ),
    Outcome.REJECTED: (
        "The last step increased the objective by more than the tolerance and was rejected; the shapes are those before it. "
        "If they are not good enough, try precision float64, weaker weights, or a tolerance above the rounding errors, such as the default."
    ),
    Outcome.STOPPED: "Stopped on request; the shapes are those of the last finished step.",
}


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """History of the reweightings, arrays of equal length; entry 0 is the initialisation."""

    objective: Floats
    """E, normalized units; increases only when the tracks are corrected again for perspective."""

    residual: Floats
    """Median reprojection residual of visible observations, the tracks' unit."""

    iterations: Ints
    """Inner conjugate-gradient iterations."""

    def __post_init__(self) -> None:
        for array in (self.objective, self.residual, self.iterations):
            read_only(array)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Solution:
    """Result of a solve."""

    shapes: Floats
    """Shape `(F, P, 3)`, world axes, the tracks' unit, centred per frame."""

    camera: Camera
    """Estimated or given cameras. If `choices.depth_sign` is `ambiguous`, all depths may have the opposite sign."""

    residuals: Floats
    """Length of the reprojection residual, shape `(F, P)`, the tracks' unit; 0 where hidden."""

    weights: Floats
    """Final IRLS weight relative to its maximum, in [0, 1], shape `(F, P)`; 0 where hidden, small for outliers."""

    trace: Trace
    """History of the reweightings."""

    outcome: Outcome
    """How the solve ended."""

    choices: Choices
    """Values chosen automatically, with reasons and warnings."""

    seconds: dict[str, float]
    """Wall time per stage."""

    shapes_std: Floats | None = None
    """Standard deviation of every position, shape `(F, P)`, the unit of the shapes; None for free surfaces without a posterior."""

    trust: Trust | None = None
    """Expected error, and a verdict with reasons."""

    inlier_probability: Floats | None = None
    """Posterior probability that an observation is an inlier, shape `(F, P)`; 0 where rejected, NaN where hidden. It is
    (1 − α) p / ((1 − α) p + α / A) with α the share of outliers, A the area of the tracks, and p the density of the loss at the scale of
    the noise; see `pliant.solver.shapes.inliers`."""

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.shapes, self.residuals, self.weights, self.shapes_std, self.inlier_probability):
            if array is not None:
                read_only(array)

    def __repr__(self) -> str:
        frames, points, _ = self.shapes.shape
        verdict = "" if self.trust is None else f", {self.trust.verdict}"
        return f"<Solution of {frames} frames × {points} points, {self.outcome}{verdict}>"

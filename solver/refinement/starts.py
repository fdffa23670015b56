"""Selection of the most probable starting cameras.

Each start is refined briefly with a shape covariance learned for it; then the likelihoods of the tracks are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import MAX_HYPOTHESIS_GAP, CameraEstimate, restarted
from pliant.solver.model.model_order import ModelOrder
from pliant.solver.records import Floats
from pliant.solver.refinement.bas_relief import settled_depth
from pliant.solver.refinement.learned import Learned, learned_at, refined, turned_once
from pliant.solver.tracks.frame_selection import evenly_spread, of_frames

START_FRAMES, COMPARED_EM_ROUNDS, FINALISTS = 40, 45, 3
"""Frames and EM rounds with which starting cameras are compared, and number of alternatives that get a second refinement. On
eleven sequences the most probable start after two refinements is the estimate itself or among the first two after one. With 90
EM rounds it is the same, or as probable to .03; with 30, the cameras of a small face are worse."""

CANDIDATE_ROUNDS = 3
"""Refinements of every candidate before candidates are compared at their most probable depths."""


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """Starting cameras and the result of their short refinement."""

    estimate: CameraEstimate

    margin: float
    """Energy by which this start must be better than the others."""

    found: Learned

    @property
    def energy(self) -> float:
        """Energy of the refined cameras plus the margin."""
        return self.found.energy + self.margin

    def refined(self, gram: Floats, should_stop: Callable[[], bool] | None) -> _Trial:
        """Return the trial after one more refinement."""
        return replace(self, found=turned_once(gram, self.found, with_scales=False, should_stop=should_stop))


def best_start(
    estimate: CameraEstimate,
    gram: Floats,
    used: NDArray[np.intp],
    model_order: ModelOrder,
    should_stop: Callable[[], bool] | None,
) -> CameraEstimate:
    """Return the estimate with its own rotations or another start's, whichever have the lowest energy after a short refinement.

    The multistart models deformation by smooth modes and turns cameras by degrees to fit it. Joint refinement hardly
    turns them back, because every mode would have to change as well. The better start can therefore be the unrefined
    cameras of a factorization, a planar object with other pose signs, or a candidate that the multistart ranks lower. A
    candidate must be better by `MAX_HYPOTHESIS_GAP`: smaller differences do not separate true cameras from false ones.
    """
    some = evenly_spread(len(used), START_FRAMES)
    part, ones = of_frames(gram, some), np.ones(len(some))

    def begun(start: CameraEstimate, margin: float) -> _Trial:
        given = np.asarray(start.rotations)[used[some]]
        found = learned_at(part, given, ones, model_order, should_stop, iterations=COMPARED_EM_ROUNDS)
        return _Trial(start, margin, found).refined(part, should_stop)

    own, others = begun(estimate, 0.0), []
    for starts, margin in ((estimate.hypotheses, 0.0), (estimate.candidates, MAX_HYPOTHESIS_GAP)):
        for other in starts:
            if should_stop is not None and should_stop():
                return estimate
            others.append(begun(restarted(estimate, other), margin))
    others.sort(key=lambda trial: trial.energy)
    finals = [trial.refined(part, should_stop) for trial in (own, *others[:FINALISTS])]
    return min(finals, key=lambda trial: trial.energy).estimate


def best_candidate(
    estimate: CameraEstimate,
    gram: Floats,
    used: NDArray[np.intp],
    found: Learned,
    model_order: ModelOrder,
    should_stop: Callable[[], bool] | None,
) -> Learned:
    """Return the most probable of `found` and all candidates of the multistart, each at its most probable depth.

    The camera-motion prior prefers rotations that are too small, whatever their direction. Only at comparable depths can it
    distinguish rotation of the object from deformation.
    """
    with_scales = bool((found.scales != 1).any())
    for candidate in estimate.candidates:
        if should_stop is not None and should_stop():
            break
        other = refined(
            gram, candidate.rotations[used], found.scales, with_scales=with_scales, rounds=CANDIDATE_ROUNDS,
            model_order=model_order, should_stop=should_stop,
        )  # fmt: skip
        if not np.isfinite(other.energy):
            break
        other, _ = settled_depth(gram, other)
        found = min(found, other, key=lambda each: each.energy)
    return found

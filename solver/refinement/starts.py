"""The most probable of several cameras to start from.

Every start is refined a little with the shape covariance that belongs to it; the likelihoods of the tracks are then compared.
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
"""Frames and rounds of EM with which starting cameras are compared, and how many of the others get a second refinement. On eleven
sequences the most probable after two refinements is the estimate itself or among the first two after one; with 90 rounds of EM
it is the same, or as probable to .03; with 30, the cameras of a small face are worse."""

CANDIDATE_ROUNDS = 3
"""Refinements of every candidate where they are compared at settled depths."""


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """Cameras to start from, and what a short refinement makes of them."""

    estimate: CameraEstimate

    margin: float
    """By how much it must be better than another start."""

    found: Learned

    @property
    def energy(self) -> float:
        """Of the refined cameras, with the margin."""
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
    """Return the estimate with the rotations, its own or those of another start, that give the lowest energy after a short refinement.

    The multistart models deformation by smooth modes and moves cameras by degrees to fit it; joint refinement hardly
    moves them back, because every mode would have to move along. The unrefined cameras of a factorization, those with
    other pose signs of a sheet, or a candidate that the multistart ranks lower, can therefore be the better start. A
    candidate must be better by `MAX_HYPOTHESIS_GAP`: smaller differences do not tell true cameras from false ones.
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
    """Return the most probable cameras among `found` and those from every candidate of the multistart, each at its settled depth.

    The prior on camera motion prefers rotations that are too small, whatever their direction. Only at comparable depths does it distinguish
    a turn of the object from its deformation.
    """
    for candidate in estimate.candidates:
        if should_stop is not None and should_stop():
            break
        other = refined(
            gram, candidate.rotations[used], found.scales, with_scales=False, rounds=CANDIDATE_ROUNDS,
            model_order=model_order, should_stop=should_stop,
        )  # fmt: skip
        if not np.isfinite(other.energy):
            break
        other, _ = settled_depth(gram, other)
        found = min(found, other, key=lambda each: each.energy)
    return found

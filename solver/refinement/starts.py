"""Selection of the most probable starting cameras.

Each start is refined briefly with a shape covariance learned for it; then the likelihoods of the tracks are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.cameras.estimation import MAX_HYPOTHESIS_GAP, CameraEstimate, with_other_cameras
from pliant.solver.records import Floats
from pliant.solver.refinement.bas_relief import at_probable_depth
from pliant.solver.refinement.evidence import Evidence
from pliant.solver.refinement.learned import Learned, Refinement
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

    def refined(self, gram: Floats, how: Refinement) -> _Trial:
        """Return the trial after one more refinement."""
        return replace(self, found=how.refine_once(gram, self.found))


def best_start(evidence: Evidence, how: Refinement) -> CameraEstimate:
    """Return the estimate with its own rotations or another start's, whichever have the lowest energy after a short refinement.

    The multistart models deformation by smooth modes and turns cameras by degrees to fit it. Joint refinement hardly
    turns them back, because every mode would have to change as well. The better start can therefore be the unrefined
    cameras of a factorization, a planar object with other pose signs, or a candidate that the multistart ranks lower. A
    candidate must be better by `MAX_HYPOTHESIS_GAP`: smaller differences do not separate true cameras from false ones.
    """
    estimate, some = evidence.estimate, evenly_spread(len(evidence.used), START_FRAMES)
    part, ones = of_frames(evidence.gram, some), np.ones(len(some))

    def begun(start: CameraEstimate, margin: float) -> _Trial:
        given = start.rotations[evidence.used[some]]
        return _Trial(start, margin, how.learn(part, given, ones, iterations=COMPARED_EM_ROUNDS)).refined(part, how)

    own, others = begun(estimate, 0.0), []
    for starts, margin in ((estimate.hypotheses, 0.0), (estimate.candidates, MAX_HYPOTHESIS_GAP)):
        for other in starts:
            if how.should_stop():
                return estimate
            others.append(begun(with_other_cameras(estimate, other), margin))
    others.sort(key=lambda trial: trial.energy)
    finals = [trial.refined(part, how) for trial in (own, *others[:FINALISTS])]
    return min(finals, key=lambda trial: trial.energy).estimate


def best_candidate(evidence: Evidence, found: Learned, how: Refinement) -> Learned:
    """Return the most probable of `found` and all candidates of the multistart, each at its most probable depth.

    The camera-motion prior prefers rotations that are too small, whatever their direction. Only at comparable depths can it
    distinguish rotation of the object from deformation.
    """
    gram = evidence.gram
    for candidate in evidence.estimate.candidates:
        if how.should_stop():
            break
        other = how.learn(gram, candidate.rotations[evidence.used], found.scales)
        other = how.refine(gram, other, rounds=CANDIDATE_ROUNDS)
        if not np.isfinite(other.energy):
            break
        other, _ = at_probable_depth(gram, other)
        found = min(found, other, key=lambda each: each.energy)
    return found

"""Remaining time of the stage `shapes`: the reweightings until the objective converges, and the duration of each.

The number of reweightings is not known in advance. Three regularities predict it:

- Where a point is hidden for ℓ frames, the equations link these frames in a chain. Conjugate gradients then need more iterations, and
  their remaining errors require more reweightings.
- The first reweightings, which decrease the objective a lot, do not predict the later ones.
- After that, the relative decrease falls more slowly than geometrically and faster than a power of the step number. Where nothing is
  hidden it falls steeply, and conjugate gradients stop early because little decrease is left to gain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

ITERATIONS_PER_UNSEEN_FRAME, FEWEST_ITERATIONS, MOST_ITERATIONS = 0.5, 5.0, 60.0
"""Conjugate-gradient iterations of a reweighting: per frame of `unseen_frames`, the minimum (where nothing is hidden), and the maximum.
Measured on spheres of 24 to 60 frames whose points are hidden for 10 to 26 frames in a row: 6 to 12."""

USUAL, PER_UNSEEN_FRAME, MOST_USUAL = 6.0, 0.6, 20.0
"""Expected reweightings: where nothing is hidden (measured: 5 to 7), in addition per frame of `unseen_frames`, and at most. Measured on the
same spheres: 11 to 20, with given cameras 31."""

USUAL_AGAIN = 4.0
"""Expected reweightings after a correction of the tracks for perspective, which starts near the minimum."""

TRANSIENT = 0.01
"""Relative decrease of the objective above which it is not extrapolated."""

EXTRAPOLATED_LATE = 2.0
"""Number of decreases below `TRANSIENT` at which their extrapolation weighs as much as the usual number of reweightings. Once the usual
number is done, only the extrapolation counts."""

STEEPEST = {True: 1.5, False: 3.0}
"""Cap on the extrapolated slope, the logarithm of the ratio of consecutive decreases; the key is whether points are hidden. Measured on
faces, flags and talking heads of 10 to 60 frames without hidden points, from the first decrease below `TRANSIENT` on: 2.6 to 4.9; on
spheres with hidden points: .1 to .7."""

OVERHEAD = 3.0
"""Cost of a reweighting besides its iterations, in iterations: right-hand side, preconditioner, start, evaluation."""

SETTLED, SETTLING = 0.03, 0.4
"""Relative decrease of the objective below which the next reweighting needs fewer iterations if nothing is hidden, and the factor. Measured
on the same sequences: factors of 1 to 2.4 after decreases of .1 and more, of .09 to .75 (median .4) after decreases of .011 and less."""

PRIOR_UNITS = 3.0
"""Weight of the planned time of an iteration beside the measured time, in iterations."""


def expected_iterations(unseen: float) -> float:
    """Return the conjugate-gradient iterations of a reweighting, for points hidden for `unseen` frames in a row."""
    return min(max(ITERATIONS_PER_UNSEEN_FRAME * unseen, FEWEST_ITERATIONS), MOST_ITERATIONS)


def expected_reweightings(unseen: float) -> float:
    """Return the usual number of reweightings, for points hidden for `unseen` frames in a row."""
    return min(USUAL + PER_UNSEEN_FRAME * unseen, MOST_USUAL)


def steps_left(
    last: float, before: float | None, taken: int, *, tolerance: float, steepest: float = STEEPEST[True]
) -> float:
    """Return the number of further steps until the relative decrease falls below a tolerance.

    The geometric mean of two extrapolations from the last two decreases: geometric, and as a power of the step number.

    Parameters
    ----------
    last : float
        Relative decrease of the objective in the last step.
    before : float or None
        The same in the step before; None after the first step.
    taken : int
        Steps so far.
    tolerance : float
        Relative decrease at which the minimisation ends.
    steepest : float
        Cap on the slope, see `STEEPEST`.
    """
    if last <= tolerance:
        return 0.0
    slope = math.log(before / last) if before is not None and before > 0 else 1.0
    slope = min(max(slope, 0.02), steepest)  # neither a standstill nor the initial steep fall continues
    further = math.log(last / tolerance)
    geometric = further / slope
    power = slope / math.log(taken / (taken - 1)) if taken > 1 else slope / math.log(2)
    return math.sqrt(geometric * taken * math.expm1(min(further / power, 5.0)))


@dataclass(slots=True)
class Descent:
    """Reweightings so far, and the expected remaining ones.

    Parameters
    ----------
    unseen : float
        `stages.unseen_frames` of the tracks.
    tolerance : float
        Relative decrease at which the minimisation ends.
    most : int
        Largest number of reweightings.
    """

    unseen: float = 0.0
    tolerance: float = 1e-4
    most: int = 100
    began: float = 0.0
    """Clock at the start, seconds."""

    corrections: int = 0
    """Maximum number of corrections of the tracks for perspective still to come, each with further reweightings."""

    corrected: bool = False
    """Whether the tracks have been corrected."""

    objectives: list[float] = field(default_factory=list)
    """Objective at the start and after every reweighting since the last correction."""

    reweightings: int = 0
    iterations: int = 0
    """Iterations of all finished reweightings."""

    last: int = 0
    """Iterations of the last finished reweighting."""

    current: int = 0
    """Iterations of the current reweighting so far."""

    def begin(self, objective: float | None, now: float) -> None:
        """Start the clock and record the initial objective, if it is known."""
        self.began = now
        self.objectives = [] if objective is None else [objective]
        self.current = 0

    def expect_corrections(self, ahead: int) -> None:
        """Expect at most `ahead` corrections; a call after the first reweighting marks a finished correction."""
        self.corrections = ahead
        if self.reweightings > 0:
            self.corrected, self.objectives = True, []

    def reweighted(self, objective: float) -> None:
        """Record a finished reweighting."""
        self.objectives.append(objective)
        self.reweightings += 1
        self.iterations += self.current
        self.last, self.current = self.current, 0

    def reweightings_left(self) -> float:
        """Return the expected number of further reweightings, including the current one."""
        # Each correction moves the tracks less than the one before.
        further = self.corrections * (self.corrections + 1) / 3
        taken = max(len(self.objectives) - 1, 0)
        decreases = self._decreases()
        usual = USUAL_AGAIN if self.corrected else expected_reweightings(self.unseen)
        if not decreases:
            return usual + further
        if decreases[-1] <= self.tolerance:
            return further
        small = sum(decrease < TRANSIENT for decrease in decreases)
        left = max(usual - taken, 1.0 if small else 2.0)
        if small:
            before = decreases[-2] if taken > 1 else None
            extrapolated = max(
                steps_left(decreases[-1], before, taken, tolerance=self.tolerance, steepest=STEEPEST[self.unseen > 0]),
                1.0,
            )
            trust = max(small / (small + EXTRAPOLATED_LATE), min(taken / usual, 1.0))
            left = left ** (1 - trust) * extrapolated**trust
        return min(left, max(self.most - taken, 0)) + further

    def units_ahead(self) -> float:
        """Return the expected units of work per remaining reweighting; late reweightings need fewer."""
        expected = expected_iterations(self.unseen) + OVERHEAD
        if self.reweightings == 0:
            return max(expected, float(self.current))
        if self.unseen > 0:
            return min(self.last, expected)
        decreases = self._decreases()
        settling = len(decreases) > 0 and decreases[-1] < SETTLED
        return min(self.last, OVERHEAD) + max(self.last - OVERHEAD, 0.0) * (SETTLING if settling else 1.0)

    def _decreases(self) -> list[float]:
        """Return the relative decreases of the objective since the last correction."""
        return [
            max(before - after, 0.0) / max(abs(before), 1e-300)
            for before, after in zip(self.objectives, self.objectives[1:], strict=False)
        ]

    def share(self) -> float:
        """Return the completed share of the expected reweightings."""
        left = self.reweightings_left()
        return self.reweightings / (self.reweightings + left) if self.reweightings else 0.0

    def seconds_left(self, now: float, *, seconds_per_iteration: float) -> float:
        """Return the expected seconds until the objective converges, given the planned time of an iteration."""
        units = self.iterations + self.current + self.reweightings
        per_unit = (now - self.began + PRIOR_UNITS * seconds_per_iteration) / (units + PRIOR_UNITS)
        ahead = self.reweightings_left() * (1 + self.units_ahead())
        # Subtract the finished iterations of the current reweighting.
        return per_unit * max(ahead - self.current, min(ahead, 1.0))

"""How long the shapes still take: reweightings until the objective settles, and the time of each.

The number of reweightings is not known before. Three regularities predict it:

- Where a point is hidden for ℓ frames, the equations link these frames in a chain: conjugate gradients need more iterations, and the errors
  that they leave make more reweightings necessary.
- The first reweightings, with large decreases of the objective, say nothing about the rest.
- Afterwards the relative decrease falls slower than geometrically and faster than a power of the step; between the two lies the truth.
  Where nothing is hidden it falls steeply, and conjugate gradients end early, since a negligible decrease is left to gain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

ITERATIONS_PER_UNSEEN_FRAME, FEWEST_ITERATIONS, MOST_ITERATIONS = 0.5, 5.0, 60.0
"""Iterations of conjugate gradients in a reweighting per frame of `unseen_frames`, and where nothing is hidden; at most 60 are done.
Measured on spheres of 24 to 60 frames, of which a point is hidden for 10 to 26 frames in a row: 6 to 12."""

USUAL, PER_UNSEEN_FRAME, MOST_USUAL = 6.0, 0.6, 20.0
"""Reweightings where all is seen (5 to 7), how many more for each of `unseen_frames`, and the largest number that is expected. Measured on
the same spheres: 11 to 20, with given cameras 31."""

USUAL_AGAIN = 4.0
"""Reweightings after a correction of the tracks for perspective, which starts near the end."""

TRANSIENT = 0.01
"""Relative decrease of the objective above which it is not extrapolated."""

EXTRAPOLATED_LATE = 2.0
"""Number of decreases below `TRANSIENT` at which their extrapolation counts as much as the usual number; after that number it
counts alone."""

STEEPEST = {True: 1.5, False: 3.0}
"""Largest logarithm of a decrease over the next one that is extrapolated, with hidden points and without. Measured without, on faces, flags
and talking heads of 10 to 60 frames: 2.6 to 4.9 from the first decrease below `TRANSIENT` on; with, on spheres: .1 to .7."""

OVERHEAD = 3.0
"""Units of a reweighting besides the iterations: right-hand side, preconditioner, start, evaluation."""

SETTLED, SETTLING = 0.03, 0.4
"""Relative decrease of the objective after which, where nothing is hidden, a reweighting needs fewer iterations than the one before, and
the share. Measured on the same sequences: after decreases of .1 and more, 1 to 2.4 times as many; after those of .011 and less, .09 to .75,
median .4."""

PRIOR_UNITS = 3.0
"""Iterations for which the planned time of an iteration counts beside the measured one."""


def expected_iterations(unseen: float) -> float:
    """Return the iterations of conjugate gradients in a reweighting, for points hidden for `unseen` frames in a row."""
    return min(max(ITERATIONS_PER_UNSEEN_FRAME * unseen, FEWEST_ITERATIONS), MOST_ITERATIONS)


def expected_reweightings(unseen: float) -> float:
    """Return the usual number of reweightings, for points hidden for `unseen` frames in a row."""
    return min(USUAL + PER_UNSEEN_FRAME * unseen, MOST_USUAL)


def steps_left(
    last: float, before: float | None, taken: int, *, tolerance: float, steepest: float = STEEPEST[True]
) -> float:
    """Return how many more steps bring a relative decrease below a tolerance.

    The geometric mean of two extrapolations of the last two decreases: geometric, and as a power of the step's number.

    Parameters
    ----------
    last, before : float
        Relative decrease of the objective in the last step and in the one before, if there is one.
    taken : int
        Steps so far.
    tolerance : float
        Relative decrease at which the minimisation ends.
    steepest : float
        Largest slope that is extrapolated, see `STEEPEST`.
    """
    if last <= tolerance:
        return 0.0
    slope = math.log(before / last) if before is not None and before > 0 else 1.0
    slope = min(max(slope, 0.02), steepest)  # the decrease neither stands still nor goes on falling as fast as at first
    further = math.log(last / tolerance)
    geometric = further / slope
    power = slope / math.log(taken / (taken - 1)) if taken > 1 else slope / math.log(2)
    return math.sqrt(geometric * taken * math.expm1(min(further / power, 5.0)))


@dataclass(slots=True)
class Descent:
    """The reweightings so far and those to expect.

    Parameters
    ----------
    unseen : float
        Of the tracks, see `stages.unseen_frames`.
    tolerance : float
        Relative decrease at which the minimisation ends.
    most : int
        Largest number of reweightings.
    """

    unseen: float = 0.0
    tolerance: float = 1e-4
    most: int = 100
    began: float = 0.0
    """Clock at the start."""

    corrections: int = 0
    """Corrections of the tracks for perspective that may follow, each with further reweightings."""

    corrected: bool = False
    """Whether one was done."""

    objectives: list[float] = field(default_factory=list)
    """After every reweighting since the last correction, that of the start first."""

    reweightings: int = 0
    iterations: int = 0
    """Of all reweightings that ended."""

    last: int = 0
    """Iterations of the last reweighting."""

    current: int = 0
    """Iterations of the one under way."""

    def begin(self, objective: float | None, now: float) -> None:
        """Start the clock, at an objective."""
        self.began = now
        self.objectives = [] if objective is None else [objective]
        self.current = 0

    def expect_corrections(self, ahead: int) -> None:
        """Expect at most so many corrections; after reweightings, one was just done."""
        self.corrections = ahead
        if self.reweightings > 0:
            self.corrected, self.objectives = True, []

    def reweighted(self, objective: float) -> None:
        """Count a reweighting."""
        self.objectives.append(objective)
        self.reweightings += 1
        self.iterations += self.current
        self.last, self.current = self.current, 0

    def reweightings_left(self) -> float:
        """Return the expected number of further reweightings, that under way included."""
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
        """Return the expected units of a further reweighting: they fall in the end."""
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
        """Return the completed part, by the number of reweightings."""
        left = self.reweightings_left()
        return self.reweightings / (self.reweightings + left) if self.reweightings else 0.0

    def seconds_left(self, now: float, *, seconds_per_iteration: float) -> float:
        """Return the expected time until the objective settles, given the planned time of an iteration."""
        units = self.iterations + self.current + self.reweightings
        per_unit = (now - self.began + PRIOR_UNITS * seconds_per_iteration) / (units + PRIOR_UNITS)
        ahead = self.reweightings_left() * (1 + self.units_ahead())
        # What is done of the reweighting under way.
        return per_unit * max(ahead - self.current, min(ahead, 1.0))

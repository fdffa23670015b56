"""The stages that a solve goes through, and about how long each takes: the basis of its progress.

Stages of the cameras consist of units of work, iterations of L-BFGS and rounds of expectation maximisation, whose cost grows with the
frames that the stage uses. Only ratios of the durations matter, because the remaining time is extrapolated from the elapsed time. Which
stages run depends on the data: one that is skipped is dropped from the plan when a later one begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

UNIT_SECONDS, FRAME_SECONDS = 1e-4, 1.9e-5
"""Seconds per unit of work, and per unit and frame, on one core: .19 ms at 10 frames, .41 at 30, .73 at 48, 1.4 at 74."""

POINT_SECONDS = {True: 1.2e-5, False: 6e-6}
"""Seconds per frame and point of the shapes with and without a learned prior. With one they depend on the conditioning: .3e-5 on a
rigid face, 2.4e-5 on ten frames of a face, 1e-4 on a flag, 1.6e-4 on a sphere; `Pace` therefore measures them."""

SETUP_SECONDS = 0.1
"""Of the shapes."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of a solve."""

    name: str
    seconds: float
    """Expected duration."""

    units: int
    """Expected units of work."""


COMPLETION_SECONDS, MOST_COMPLETED = 1.2e-4, 600
"""Seconds per frame and point of filling hidden positions, and the largest number of points that takes part."""

UNITS = {
    "multistart": (1600, 120, 1.3),
    "model_order": (1000, 360, 0.6),
    "starts": (2500, 40, 1.0),
    "perspective": (10, 360, 30.0),
    "scales": (1500, 120, 1.0),
    "refinement": (2000, 360, 1.0),
    "covariance": (380, 360, 1.0),
    "trust": (6, 100, 130.0),
}
"""Stages of the default prior: typical number of units, maximum number of frames used, and cost of a unit against that of an iteration.
Measured on sequences of 10 to 80 frames, clean and spoiled."""

FIRST_REWEIGHTING = 2.5
"""Time that the shapes take after their first reweighting has begun, over what it has taken so far; seven reweightings are usual and the
first takes longest."""

PACE_PRIOR = 0.5
"""Seconds of the plan that count as measured at the planned pace, so that the first units do not decide the pace alone."""

USUAL_RATIO = 0.4
"""Decrease of the objective of a reweighting over that of the one before, where it is not known yet."""

REFINEMENT_UNITS = {True: 3600, False: 700}
"""Units of the stage `refinement` where the covariance may couple the modes, and where the model order rules that out. The plan has a
number between, until this is known."""

UNITS_PER_START = 500
"""Units that one starting point of the stage `starts` takes."""


def planned(
    frames: int, points: int, *, gaussian: bool, known_cameras: bool, sheet: bool, hidden: bool = False
) -> tuple[Stage, ...]:
    """Return the stages that a solve is expected to have, in their order.

    Parameters
    ----------
    frames, points : int
        Size of the tracks.
    gaussian : bool
        Whether the prior is learned.
    known_cameras : bool
        Whether rotations are given.
    sheet : bool
        Whether an isometric surface is looked for.
    hidden : bool
        Whether any point is hidden in any frame.
    """
    shapes = Stage("shapes", SETUP_SECONDS + POINT_SECONDS[gaussian] * frames * points, 100)
    last = [stage_of("trust", frames)] if gaussian else []
    first = [Stage("surface", 0.5 + 0.35 * min(frames, 24), 280)] if sheet else []
    filled = COMPLETION_SECONDS * frames * min(points, MOST_COMPLETED) if hidden else 0.0
    first.append(Stage("completion", 0.1 + filled, 6))
    return (*first, *learning(frames, gaussian=gaussian, known_cameras=known_cameras), shapes, *last)


def learning(frames: int, *, gaussian: bool, known_cameras: bool) -> tuple[Stage, ...]:
    """Return the stages of cameras and prior; they run twice where the tracks have outliers."""
    names = ["multistart", "model_order", "starts", "perspective", "scales", "refinement", "covariance"]
    if known_cameras:
        names = ["model_order", "covariance"] if gaussian else []
    elif not gaussian:
        names = ["multistart"]
    return tuple(stage_of(name, frames) for name in names)


def stage_of(name: str, frames: int, *, units: int | None = None) -> Stage:
    """Return a stage of `UNITS` for so many frames; `units` where their number is known."""
    count, most_frames, cost = UNITS[name]
    used = count if units is None else units
    return Stage(name, used * cost * (UNIT_SECONDS + FRAME_SECONDS * min(frames, most_frames)), used)


def settling(objectives: Sequence[float], *, tolerance: float, most: int) -> float:
    """Return the completed part of a minimisation, from the decrease of its objective.

    The relative decrease falls about geometrically from step to step, so the number of steps until it is below `tolerance` follows from the
    last two; at most `most` steps are taken. With fewer than two decreases the ratio is taken as `USUAL_RATIO`.

    Parameters
    ----------
    objectives : sequence of float
        After every step, that of the start first.
    tolerance : float
        Relative decrease at which the minimisation ends.
    most : int
        Largest number of steps.
    """
    taken = len(objectives) - 1
    if taken < 1:
        return 0.0
    values = np.asarray(objectives, dtype=np.float64)
    decreases = np.maximum(-np.diff(values), 0.0) / np.maximum(np.abs(values[:-1]), np.finfo(float).tiny)
    last = float(decreases[-1])
    if last <= tolerance:
        return 1.0
    ratio = last / float(decreases[-2]) if taken > 1 and decreases[-2] > 0 else USUAL_RATIO
    ratio = float(np.clip(ratio, 0.25, 0.9))  # the decrease slows down later
    left = np.log(tolerance / last) / np.log(ratio)
    return float(taken / (taken + min(left, max(most - taken, 0))))


@dataclass(slots=True)
class Pace:
    """Remaining time of a plan, from the durations of the stages so far.

    The pace is the measured time of the finished stages over their planned time: it covers machines of other speed and with other load.
    The shapes stay out of it, because their planned time is uncertain; once they run, they are extrapolated by themselves.
    """

    began: float
    """Clock at which the current stage began."""

    measured: float = PACE_PRIOR
    planned: float = PACE_PRIOR

    def next(self, stage: Stage, share: float, now: float) -> None:
        """Count a finished stage; `share` of it is done, 0 if it was skipped."""
        if share > 0 and stage.name != "shapes":
            self.measured += now - self.began
            self.planned += stage.seconds
        self.began = now

    def left(self, stage: Stage, share: float, settled: float, ahead: float, now: float) -> float:
        """Return the remaining seconds.

        Parameters
        ----------
        stage : Stage
            The current one.
        share : float
            Completed part of it by units of work.
        settled : float
            Completed part of the shapes by their objective; 0 before the first reweighting ends.
        ahead : float
            Planned seconds of the stages that follow.
        now : float
            Clock.
        """
        spent = now - self.began
        if stage.name == "shapes":
            pace = self.measured / self.planned
            if settled > 0:  # the first reweighting takes longest, so those that are left take less each than it did
                rest = min(spent * (1 - settled) / settled, FIRST_REWEIGHTING * spent)
            else:
                rest = max(pace * stage.seconds - spent, FIRST_REWEIGHTING * spent)
            return rest + pace * ahead
        pace = (
            (self.measured + spent) / (self.planned + share * stage.seconds)
            if share > 0
            else self.measured / self.planned
        )
        planned = pace * (1 - share) * stage.seconds
        rest = planned if share <= 0 else (1 - share) * planned + share * spent * (1 - share) / share
        return rest + pace * ahead

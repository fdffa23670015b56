"""Stages of a solve and their expected durations, from which its progress is estimated.

Stages of the cameras consist of units of work: iterations of L-BFGS and of expectation maximisation, whose cost grows with the number of
frames that the stage uses. Only ratios of the durations matter, because the remaining time is extrapolated from the elapsed time. Which
stages run depends on the data; a skipped stage is dropped from the plan when a later one begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.descent import OVERHEAD, expected_iterations, expected_reweightings
from pliant.solver.limits import learned_frames
from pliant.solver.records import Floats

UNIT_SECONDS, FRAME_SECONDS = 7e-5, 1.3e-5
"""Seconds per unit of work, and in addition per unit and frame, on one core: .2 ms at 10 frames, .46 at 30, .7 at 48, 1 at 74. The times
below were measured on the same core."""

ITERATION_FRAME_SECONDS, ITERATION_SECONDS = 3e-5, {True: 5.3e-8, False: 4e-8}
"""Seconds per unit of a reweighting: per frame, and in addition per frame and point; the key is whether a prior is learned. Within 40 % of
the times measured for 40 × 800, 60 × 4,000, 99 × 600, 99 × 6,000, 300 × 300, 1,000 × 300 and 3,000 × 300."""

START_FRAME_SECONDS, START_SECONDS, START_UNITS = 5e-4, 8e-7, 9
"""Start of the shapes: seconds per frame, in addition per frame and point, and units of work. Measured for the same sizes and
50 × 100,000."""

FINISH_SECONDS = 3e-7
"""Seconds per frame and point to convert the solution to the tracks' unit and compute inlier probabilities; measured for 50 × 30,000 and
50 × 100,000."""

SURFACE_SECONDS, SURFACE_SETUP = 0.45, 40
"""Search for an isometric surface: seconds per frame, on at most 24 frames, and duration of its preparation in units of work. Measured for
paper, a comic page and a shallow face."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A stage of a solve."""

    name: str
    seconds: float
    """Expected duration."""

    units: int
    """Expected units of work."""

    growth: float = 1.0
    """Ratio of the times of consecutive units."""

    setup: int = 0
    """Duration of the preparation before the first unit, in units."""


COMPLETION_SECONDS, MOST_COMPLETED, RANK_GROWTH = 8e-7, (60, 600), 2.0
"""Completion of hidden positions: seconds per squared frame count and point; the numbers of frames and of points above which the time no
longer grows, because the ranks tried end at 40; and the ratio of the times of consecutive ranks."""

GRAM_SECONDS = 1e-9
"""Seconds per point and squared number of frames for the Gram matrix of all tracks: 8 operations, 10 s for 100 × 1,000,000."""

UNITS = {
    "multistart": (1600, 120, 1.3),
    "model_order": (1000, 360, 0.6),
    "starts": (2140, 40, 0.85),
    "perspective": (10, 360, 30.0),
    "scales": (820, 120, 0.85),
    "refinement": (1500, 360, 1.1),
    "observations": (184, 360, 6.0),
    "covariance": (380, 360, 1.0),
    "extension": (80, 1_000_000, 3.0),
    "trust": (10, 100, 60.0),
}
"""Stages of the default prior: typical number of units, maximum number of frames used, and cost of a unit relative to a unit of
`UNIT_SECONDS`. Measured on sequences of 10 to 80 frames, clean and corrupted."""

CUBIC_FRAMES = {"covariance": 200}
"""Number of frames at which a unit takes twice as long as `UNITS` predicts, because it also computes eigenvalues, whose time is cubic in
the number of frames. Measured with 360 frames: 2.6 to 2.7 times the time of a unit of `multistart`."""

PACE_PRIOR = 0.5
"""Planned seconds that count as measured at the planned pace, so that the first units alone do not determine the pace."""

REFINEMENT_UNITS = {True: 2930, False: 185}
"""Units of the stage `refinement`; the key is whether the covariance may couple the modes. Until the model order determines this, the plan
has a number in between."""

LOAD_SECONDS, LOAD_PRIOR = 20.0, 1.0
"""Seconds over which the load of the machine is measured, and processor seconds that count as measured without load."""

OWN_PACE = 4.0
"""Weight of a stage's own pace, per completed share of it, relative to the pace of all stages: its units take similar times."""

GIVEN_ROTATIONS = (1.56, 1.6)
"""Stage `scales` with given rotations, which has a third start, relative to estimated ones: number of units (1,283), and time of a unit.
Measured for 30, 60 and 99 frames."""

UNITS_PER_START = 195
"""Units per starting point of the stage `starts`, averaged over eleven, including the second refinement of the best."""


def planned(
    frames: int,
    points: int,
    *,
    gaussian: bool,
    known_cameras: bool,
    sheet: bool,
    known_scales: bool = False,
    ordered: bool = True,
    unseen: float = 0.0,
) -> tuple[Stage, ...]:
    """Return the expected stages of a solve, in order.

    Parameters
    ----------
    frames : int
        F.
    points : int
        P.
    gaussian : bool
        Whether the prior is learned.
    known_cameras : bool
        Whether rotations are given.
    known_scales : bool
        Whether scales are given with the rotations.
    ordered : bool
        True for a film, False for photographs in no order.
    sheet : bool
        Whether the tracks are tested for an isometric surface.
    unseen : float
        `unseen_frames` of the tracks.
    """
    iterations = expected_iterations(unseen)
    work = expected_reweightings(unseen) * (1 + iterations + OVERHEAD)
    start = Stage("start", frames * (START_FRAME_SECONDS + START_SECONDS * points), START_UNITS)
    shapes = Stage("shapes", work * iteration_seconds(frames, points, gaussian=gaussian), 100)
    last = [Stage("finish", FINISH_SECONDS * frames * points, 3), *([stage_of("trust", frames)] if gaussian else [])]
    first = [Stage("surface", SURFACE_SECONDS * min(frames, 24), 280, setup=SURFACE_SETUP)] if sheet else []
    most_frames, most_points = MOST_COMPLETED
    filled = COMPLETION_SECONDS * frames * min(frames, most_frames) * min(points, most_points) if unseen > 0 else 0.0
    used = learned_frames(frames) if ordered else frames
    filled += GRAM_SECONDS * used**2 * points
    first.append(Stage("completion", 0.1 + filled, 6, growth=RANK_GROWTH))
    learned = learning(frames, used, gaussian=gaussian, known_cameras=known_cameras, known_scales=known_scales)
    return (*first, *learned, start, shapes, *last)


def iteration_seconds(frames: int, points: int, *, gaussian: bool) -> float:
    """Return the expected seconds of a unit of a reweighting: a conjugate-gradient iteration, or work of the same duration."""
    return frames * (ITERATION_FRAME_SECONDS + ITERATION_SECONDS[gaussian] * points)


def unseen_frames(visible: Floats) -> float:
    """Return the longest run of frames in which a point is hidden, averaged over the points of `visible (F, P)`."""
    current = np.zeros(visible.shape[1])
    longest = current.copy()
    for hidden in visible <= 0:
        current = np.where(hidden, current + 1, 0.0)
        np.maximum(longest, current, out=longest)
    return float(longest.mean())


def learning(
    frames: int, used: int, *, gaussian: bool, known_cameras: bool, known_scales: bool = False
) -> tuple[Stage, ...]:
    """Return the stages of cameras and prior, learned from `used` of the frames; `Monitor.expect` later adds those of hidden entries."""
    names = ["multistart", "model_order", "starts", "perspective", "scales", "refinement", "covariance"]
    if known_cameras:
        names = ["model_order", *([] if known_scales else ["scales"]), "covariance"] if gaussian else []
    elif not gaussian:
        names = ["multistart"]
    stages = [stage_of(name, used) for name in names]
    if gaussian and used < frames:
        stages.append(stage_of("extension", frames))
    return tuple(_longer(stage) if known_cameras and stage.name == "scales" else stage for stage in stages)


def _longer(scales: Stage) -> Stage:
    units, cost = GIVEN_ROTATIONS
    return replace(scales, seconds=units * cost * scales.seconds, units=round(units * scales.units))


def stage_of(name: str, frames: int) -> Stage:
    """Return the stage `name` of `UNITS` for a number of frames."""
    units, most_frames, cost = UNITS[name]
    used = min(frames, most_frames)
    curved = 1 + used / CUBIC_FRAMES[name] if name in CUBIC_FRAMES else 1.0
    return Stage(name, units * cost * curved * (UNIT_SECONDS + FRAME_SECONDS * used), units)


@dataclass(slots=True)
class Pace:
    """Remaining time of a plan, from the durations of the stages so far.

    The pace is the measured time of the finished stages divided by the planned time of the work they did, which adapts the plan to speed
    and load of the machine. A stage that ended early counts with its finished units only, or it would make the machine look faster. The
    stage `shapes` is excluded, because `Descent` extrapolates it separately.
    """

    began: float
    """Processor time at which the current stage began."""

    measured: float = PACE_PRIOR
    planned: float = PACE_PRIOR

    def next(self, stage: Stage, share: float, now: float) -> None:
        """Record a finished stage; `share` is the completed share of its units, 0 if it was skipped."""
        if share > 0 and stage.name != "shapes":
            self.measured += now - self.began
            self.planned += share * stage.seconds
        self.began = now

    @property
    def known(self) -> float:
        """Ratio of measured to planned time of the finished stages."""
        return self.measured / self.planned

    def left(self, stage: Stage, share: float, ahead: float, now: float) -> float:
        """Return the remaining seconds.

        Parameters
        ----------
        stage : Stage
            The current stage; not `shapes`, unless it is solved in blocks.
        share : float
            Completed share of it.
        ahead : float
            Planned seconds of the stages that follow.
        now : float
            Processor time, seconds.
        """
        spent = now - self.began
        if share <= 0:
            return max(self.known * stage.seconds - spent, 0.0) + self.known * ahead
        pace = (self.measured + spent) / (self.planned + share * stage.seconds)
        own = min(OWN_PACE * share, 1.0)
        rest = (1 - share) * ((1 - own) * pace * stage.seconds + own * spent / share)
        return rest + pace * ahead


class Load:
    """Wall time per processor second of this process, measured over the last `LOAD_SECONDS`.

    Above 1 if other processes use the cores, below 1 if this process uses several cores.
    """

    def __init__(self, now: float, work: float) -> None:
        self._old = self._middle = (now, work)

    def seconds_per_work(self, now: float, work: float) -> float:
        """Return the latest ratio, given wall time `now` and processor time `work`, both in seconds."""
        if now - self._middle[0] > LOAD_SECONDS / 2:
            self._old, self._middle = self._middle, (now, work)
        return (now - self._old[0] + LOAD_PRIOR) / (work - self._old[1] + LOAD_PRIOR)

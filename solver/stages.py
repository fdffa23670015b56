"""The stages that a solve goes through, and about how long each takes: the basis of its progress.

Stages of the cameras consist of units of work, iterations of L-BFGS and rounds of expectation maximisation, whose cost grows with the
frames that the stage uses. Only ratios of the durations matter, because the remaining time is extrapolated from the elapsed time. Which
stages run depends on the data: one that is skipped is dropped from the plan when a later one begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.descent import OVERHEAD, expected_iterations, expected_reweightings
from pliant.solver.limits import LEARNED_FRAMES
from pliant.solver.records import Floats

UNIT_SECONDS, FRAME_SECONDS = 7e-5, 1.3e-5
"""Seconds per unit of work, and per unit and frame, on one core: .2 ms at 10 frames, .46 at 30, .7 at 48, 1 at 74. The other times
below are of the same core."""

ITERATION_FRAME_SECONDS, ITERATION_SECONDS = 3e-5, {True: 5.3e-8, False: 4e-8}
"""Seconds per unit of a reweighting and frame, whatever the number of points, and further ones per frame and point, with and without a
learned prior; measured for 40 × 800, 60 × 4,000, 99 × 600, 99 × 6,000, 300 × 300, 1,000 × 300 and 3,000 × 300: within 40 %."""

START_FRAME_SECONDS, START_SECONDS, START_UNITS = 5e-4, 8e-7, 9
"""Of the start of the shapes: seconds per frame, further ones per frame and point, and its units. Measured for the same sizes and
50 × 100,000."""

FINISH_SECONDS = 3e-7
"""Seconds per frame and point of the solution in the tracks' unit and of the probabilities; measured for 50 × 30,000 and 50 × 100,000."""

SURFACE_SECONDS, SURFACE_SETUP = 0.7, 40
"""Seconds per frame of the search for an isometric surface, on at most 24 frames, and the units that its preparation takes as long as."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of a solve."""

    name: str
    seconds: float
    """Expected duration."""

    units: int
    """Expected units of work."""

    growth: float = 1.0
    """Time of a unit over that of the one before."""

    setup: int = 0
    """Units that what comes before the first one takes as long as."""


COMPLETION_SECONDS, MOST_COMPLETED, RANK_GROWTH = 8e-7, (60, 600), 2.0
"""Seconds per frame, frame and point of filling hidden positions; the largest numbers of frames and points that count, because the ranks
that are tried end at 40; and the growth of the time from one rank to the next."""

GRAM_SECONDS = 1e-9
"""Seconds per point and square of the number of frames of the Gram matrix of all tracks: 8 operations, 10 s for 100 × 1,000,000."""

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
"""Stages of the default prior: typical number of units, maximum number of frames used, and cost of a unit against that of an iteration.
Measured on sequences of 10 to 80 frames, clean and spoiled."""

CUBIC_FRAMES = {"covariance": 200}
"""Frames for which a unit takes twice as long as the above says, because it also takes eigenvalues, whose time is cubic in the frames.
Measured with 360 frames, against the stage `multistart`: 2.6 to 2.7 times as long."""

PACE_PRIOR = 0.5
"""Seconds of the plan that count as measured at the planned pace, so that the first units do not decide the pace alone."""

REFINEMENT_UNITS = {True: 2930, False: 185}
"""Units of the stage `refinement` where the covariance may couple the modes, and where the model order rules that out. The plan has a
number between, until this is known."""

LOAD_SECONDS, LOAD_PRIOR = 20.0, 1.0
"""Seconds over which the load of the machine is measured, and processor seconds that count as measured without any load."""

OWN_PACE = 4.0
"""Weight of a stage's own pace, per completed share of it, beside that of all stages: its units take about the same time."""

GIVEN_ROTATIONS = (1.56, 1.6)
"""Units of the stage `scales` where rotations are given, which has a third start, against those where they are estimated, and time of a
unit against one there: 1,283 units; measured for 30, 60 and 99 frames."""

UNITS_PER_START = 195
"""Units that one of eleven starting points of the stage `starts` takes, with the second refinement of the best."""


def planned(
    frames: int,
    points: int,
    *,
    gaussian: bool,
    known_cameras: bool,
    sheet: bool,
    known_scales: bool = False,
    unseen: float = 0.0,
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
    known_scales : bool
        Whether scales are given with them.
    sheet : bool
        Whether an isometric surface is looked for.
    unseen : float
        Of the tracks, see `unseen_frames`.
    """
    iterations = expected_iterations(unseen)
    work = expected_reweightings(unseen) * (1 + iterations + OVERHEAD)
    start = Stage("start", frames * (START_FRAME_SECONDS + START_SECONDS * points), START_UNITS)
    shapes = Stage("shapes", work * iteration_seconds(frames, points, gaussian=gaussian), 100)
    last = [Stage("finish", FINISH_SECONDS * frames * points, 3), *([stage_of("trust", frames)] if gaussian else [])]
    first = [Stage("surface", SURFACE_SECONDS * min(frames, 24), 280, setup=SURFACE_SETUP)] if sheet else []
    most_frames, most_points = MOST_COMPLETED
    filled = COMPLETION_SECONDS * frames * min(frames, most_frames) * min(points, most_points) if unseen > 0 else 0.0
    filled += GRAM_SECONDS * min(frames, LEARNED_FRAMES) ** 2 * points
    first.append(Stage("completion", 0.1 + filled, 6, growth=RANK_GROWTH))
    learned = learning(frames, gaussian=gaussian, known_cameras=known_cameras, known_scales=known_scales)
    return (*first, *learned, start, shapes, *last)


def iteration_seconds(frames: int, points: int, *, gaussian: bool) -> float:
    """Return the seconds of a unit of a reweighting: an iteration of conjugate gradients, or what else takes about as long."""
    return frames * (ITERATION_FRAME_SECONDS + ITERATION_SECONDS[gaussian] * points)


def unseen_frames(visible: Floats) -> float:
    """Return the longest run of frames in which a point is hidden, averaged over the points of `visible (F, P)`."""
    current = np.zeros(visible.shape[1])
    longest = current.copy()
    for hidden in visible <= 0:
        current = np.where(hidden, current + 1, 0.0)
        np.maximum(longest, current, out=longest)
    return float(longest.mean())


def learning(frames: int, *, gaussian: bool, known_cameras: bool, known_scales: bool = False) -> tuple[Stage, ...]:
    """Return the stages of cameras and prior; where entries are hidden or outliers, others are added (`Monitor.expect`)."""
    names = ["multistart", "model_order", "starts", "perspective", "scales", "refinement", "covariance"]
    if known_cameras:
        names = ["model_order", *([] if known_scales else ["scales"]), "covariance"] if gaussian else []
    elif not gaussian:
        names = ["multistart"]
    if gaussian and frames > LEARNED_FRAMES:
        names.append("extension")
    stages = tuple(stage_of(name, frames) for name in names)
    return tuple(_longer(stage) if known_cameras and stage.name == "scales" else stage for stage in stages)


def _longer(scales: Stage) -> Stage:
    units, cost = GIVEN_ROTATIONS
    return replace(scales, seconds=units * cost * scales.seconds, units=round(units * scales.units))


def stage_of(name: str, frames: int) -> Stage:
    """Return a stage of `UNITS` for so many frames."""
    units, most_frames, cost = UNITS[name]
    used = min(frames, most_frames)
    curved = 1 + used / CUBIC_FRAMES[name] if name in CUBIC_FRAMES else 1.0
    return Stage(name, units * cost * curved * (UNIT_SECONDS + FRAME_SECONDS * used), units)


@dataclass(slots=True)
class Pace:
    """Remaining time of a plan, from the durations of the stages so far.

    The pace is the measured time of the finished stages over the planned time of the work that they did: it covers machines of other speed
    and with other load. A stage that ended after fewer units than planned counts by these, or it would pass for a fast machine.
    The shapes stay out of it, because `Descent` extrapolates them by themselves.
    """

    began: float
    """Processor time at which the current stage began."""

    measured: float = PACE_PRIOR
    planned: float = PACE_PRIOR

    def next(self, stage: Stage, share: float, now: float) -> None:
        """Count a finished stage; `share` of its units was done, 0 if it was skipped."""
        if share > 0 and stage.name != "shapes":
            self.measured += now - self.began
            self.planned += share * stage.seconds
        self.began = now

    @property
    def known(self) -> float:
        """Measured over planned time of the finished stages."""
        return self.measured / self.planned

    def left(self, stage: Stage, share: float, ahead: float, now: float) -> float:
        """Return the remaining seconds.

        Parameters
        ----------
        stage : Stage
            The current one, not the shapes.
        share : float
            Completed part of it.
        ahead : float
            Planned seconds of the stages that follow.
        now : float
            Clock.
        """
        spent = now - self.began
        if share <= 0:
            return max(self.known * stage.seconds - spent, 0.0) + self.known * ahead
        pace = (self.measured + spent) / (self.planned + share * stage.seconds)
        own = min(OWN_PACE * share, 1.0)
        rest = (1 - share) * ((1 - own) * pace * stage.seconds + own * spent / share)
        return rest + pace * ahead


class Load:
    """Seconds that pass in one processor second of this process, measured over the last `LOAD_SECONDS`.

    More than 1 where others use the cores, less than 1 where the process uses several.
    """

    def __init__(self, now: float, work: float) -> None:
        self._old = self._middle = (now, work)

    def seconds_per_work(self, now: float, work: float) -> float:
        """Return the latest ratio, given the clock and the processor time."""
        if now - self._middle[0] > LOAD_SECONDS / 2:
            self._old, self._middle = self._middle, (now, work)
        return (now - self._old[0] + LOAD_PRIOR) / (work - self._old[1] + LOAD_PRIOR)

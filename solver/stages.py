"""Stages of a solve and their expected durations, from which its progress is estimated.

A stage consists of units of work: iterations of L-BFGS and of expectation maximisation for the cameras, of conjugate gradients for the
shapes. Only ratios of the durations matter, because the remaining time is extrapolated from the elapsed time. Which stages run depends on
the data; a skipped stage is dropped from the plan when a later one begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log

from pliant.solver.limits import learned_frames
from pliant.solver.records import Floats
from pliant.solver.tracks.frame_selection import longest_gaps

UNIT_SECONDS, FRAME_SECONDS = 7e-5, 1.3e-5
"""Seconds per unit of work, and in addition per unit and frame, on one core: .2 ms at 10 frames, .46 at 30, .7 at 48, 1 at 74. The times
below were measured on the same core."""

SHAPES_UNITS, UNITS_PER_UNSEEN_FRAME, MOST_SHAPES_UNITS = 55.0, 9.0, 300.0
"""Units of the stage `shapes`: where nothing is hidden, in addition per frame of `unseen_frames`, and at most. Where a point is hidden for
ℓ frames, the equations link these frames in a chain, so conjugate gradients need more iterations and leave more to the next reweighting.
Measured: 35 to 91, and 223 for points hidden for 18 frames in a row."""

SHAPES_TOLERANCE = 1e-4
"""Tolerance at which these units were measured. Reweighting converges linearly, so they grow with its logarithm: of a face of 40 × 800, 61,
125, 212, 324 and 556 with 1e-2, 1e-4, 1e-6, 1e-8 and 1e-12."""

ITERATION_FRAME_SECONDS, ITERATION_SECONDS = 2e-5, {True: 7e-8, False: 5e-8}
"""Seconds per unit of a reweighting: per frame, and in addition per frame and point; the key is whether a prior is learned. Within a factor
of 1.7 of the times measured for 10 × 20,000, 40 × 800, 50 × 100,000, 60 × 4,000, 60 × 10,000, 99 × 6,000 and 3,000 × 300."""

START_FRAME_SECONDS, START_SECONDS, START_UNITS = 5e-4, 8e-7, 9
"""Start of the shapes: seconds per frame, in addition per frame and point, and units of work. Measured for the same sizes and
50 × 100,000."""

FINISH_SECONDS = 3e-7
"""Seconds per frame and point to convert the solution to the tracks' unit and compute inlier probabilities; measured for 50 × 30,000 and
50 × 100,000."""

SURFACE_SECONDS, SURFACE_FRAMES, SURFACE_UNITS, SURFACE_SETUP = 0.45, 24, 280, 40
"""Search for an isometric surface: seconds per frame, the number of frames on which it is done, units of work, and duration of its
preparation in units of work. Measured for paper, a comic page and a shallow face."""

FIRST_LOOK_UNITS, ANCHORS_SECONDS = 13, 0.01
"""Of more frames, the units of work before their anchors are chosen, and the seconds of choosing them per frame: .004 with 300 points, .01
with 2,000 and 8,000, each in 100, 300 and 600 frames."""

SHEET_SECONDS, SHEET_UNITS = 2.0, 60
"""An accepted sheet: seconds and units of solving the frames of the search again; 2.2 s for 20 frames of 144 points."""

SHEET_FRAME_SECONDS, SHEET_FRAMES_UNITS = 0.055, 60
"""Then in all of more frames: seconds per frame, and units. Measured for paper: .02 to .05 with 60 to
600 frames; with 3,000, the plan's total is 95 % of the time."""

SHEET_POINT_SECONDS = 4e-6
"""And in all points: seconds per frame and point, measured for 20 and 150 frames of 10,000 points."""

SHEET_ERROR_SECONDS, SHEET_ERROR_UNITS = 2.0, 130
"""And its standard deviations, in the frames of the search: seconds and units. Measured for paper and a comic page."""

COMPLETION_SECONDS, MOST_COMPLETED, RANK_GROWTH = 8e-7, (60, 600), 2.0
"""Completion of hidden positions: seconds per squared frame count and point; the numbers of frames and of points above which the time no
longer grows, because the ranks tried end at 40; and the ratio of the times of consecutive ranks."""

GRAM_SECONDS = 1e-9
"""Seconds per point and squared number of frames for the Gram matrix of all tracks: 8 operations, 10 s for 100 × 1,000,000."""

FACTORIZATION_SECONDS = 2e-6
"""Seconds per squared number of frames for the leading eigenvectors of the Gram matrix of all frames: 5 for 2,000 frames, 15 for 3,000."""

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

REFINEMENT_UNITS = {True: 2930, False: 185}
"""Units of the stage `refinement`; the key is whether the covariance may couple the modes. Until the model order determines this, the plan
has a number in between."""

GIVEN_ROTATIONS = (1.56, 1.6)
"""Stage `scales` with given rotations, which has a third start, relative to estimated ones: number of units (1,283), and time of a unit.
Measured for 30, 60 and 99 frames."""

UNITS_PER_START = 195
"""Units per starting point of the stage `starts`, averaged over eleven, including the second refinement of the best."""


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
    tolerance: float = SHAPES_TOLERANCE,
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
    tolerance : float
        `Settings.tolerance`.
    """
    start = Stage("start", frames * (START_FRAME_SECONDS + START_SECONDS * points), START_UNITS)
    units = min(SHAPES_UNITS + UNITS_PER_UNSEEN_FRAME * unseen, MOST_SHAPES_UNITS)
    units = max(1.0, units * log(tolerance) / log(SHAPES_TOLERANCE))
    seconds = frames * (ITERATION_FRAME_SECONDS + ITERATION_SECONDS[gaussian] * points)
    shapes = Stage("shapes", units * seconds, round(units))
    last = [Stage("finish", FINISH_SECONDS * frames * points, 3), *([stage_of("trust", frames)] if gaussian else [])]
    first = search_for_sheet(frames) if sheet else []
    most_frames, most_points = MOST_COMPLETED
    filled = COMPLETION_SECONDS * frames * min(frames, most_frames) * min(points, most_points) if unseen > 0 else 0.0
    used = learned_frames(frames) if ordered else frames
    whole = used if gaussian else frames
    filled += GRAM_SECONDS * whole**2 * points
    # Without hidden entries, the first rank that explains the tracks is the last.
    first.append(Stage("completion", 0.1 + filled, 6 if unseen > 0 else 1, growth=RANK_GROWTH))
    if not gaussian and not known_cameras:
        first.append(Stage("factorization", FACTORIZATION_SECONDS * frames**2, 1))
    learned = learning(frames, used, gaussian=gaussian, known_cameras=known_cameras, known_scales=known_scales)
    return (*first, *learned, start, shapes, *last)


def search_for_sheet(frames: int) -> list[Stage]:
    """Return the stages of the search for an isometric surface; `anchors` and `surface` are skipped if a first look rejects it."""
    if frames <= SURFACE_FRAMES:
        return [Stage("surface", SURFACE_SECONDS * frames, SURFACE_UNITS, setup=SURFACE_SETUP)]
    each = SURFACE_SECONDS * SURFACE_FRAMES / (SURFACE_UNITS + SURFACE_SETUP)
    later = SURFACE_UNITS - FIRST_LOOK_UNITS
    look = Stage("first_look", (FIRST_LOOK_UNITS + SURFACE_SETUP) * each, FIRST_LOOK_UNITS, setup=SURFACE_SETUP)
    return [look, Stage("anchors", ANCHORS_SECONDS * frames, 1), Stage("surface", later * each, later)]


def accepted_sheet(frames: int, points: int) -> list[Stage]:
    """Return the stages that remain once the tracks are found to be those of an isometric surface."""
    searched = min(frames / SURFACE_FRAMES, 1.0)
    stages = [Stage("sheet", SHEET_SECONDS * searched, SHEET_UNITS)]
    if frames > SURFACE_FRAMES:
        stages.append(Stage("sheet_frames", SHEET_FRAME_SECONDS * frames, SHEET_FRAMES_UNITS))
    stages.append(Stage("sheet_points", SHEET_POINT_SECONDS * frames * points, 1))
    return [*stages, Stage("sheet_error", SHEET_ERROR_SECONDS * searched, SHEET_ERROR_UNITS)]


def unseen_frames(visible: Floats) -> float:
    """Return the longest run of frames in which a point is hidden, averaged over the points of `visible (F, P)`."""
    return float(longest_gaps(visible).mean())


def learning(frames: int, used: int, *, gaussian: bool, known_cameras: bool, known_scales: bool) -> tuple[Stage, ...]:
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

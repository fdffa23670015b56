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

POINT_SECONDS, SETUP_SECONDS = 8e-6, 0.1
"""Seconds per frame and point of a reweighting times the usual number of them, and of the setup of the shapes."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of a solve."""

    name: str
    seconds: float
    """Expected duration."""

    units: int
    """Expected units of work."""


UNITS = {
    "multistart": (1600, 120, 1.3),
    "model_order": (1000, 360, 0.6),
    "starts": (2500, 40, 1.0),
    "perspective": (10, 360, 30.0),
    "scales": (1500, 120, 1.0),
    "refinement": (700, 360, 1.0),
    "covariance": (500, 360, 1.0),
    "trust": (6, 100, 130.0),
}
"""Stages of the default prior: typical number of units, maximum number of frames used, and cost of a unit against that of an iteration.
Measured on sequences of 10 to 74 frames, clean and spoiled."""

USUAL_RATIO = 0.4
"""Decrease of the objective of a reweighting over that of the one before, where it is not known yet."""

UNITS_PER_START = 500
"""Units that one starting point of the stage `starts` takes."""


def planned(frames: int, points: int, *, gaussian: bool, known_cameras: bool, sheet: bool) -> tuple[Stage, ...]:
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
    """
    shapes = Stage("shapes", SETUP_SECONDS + POINT_SECONDS * frames * points, 100)
    last = [stage_of("trust", frames)] if gaussian else []
    first = [Stage("surface", 0.5 + 0.1 * min(frames, 24), 150)] if sheet else []
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
    ratio = float(np.clip(ratio, 0.1, 0.9))
    left = np.log(tolerance / last) / np.log(ratio)
    return float(taken / (taken + min(left, max(most - taken, 0))))

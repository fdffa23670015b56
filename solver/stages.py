"""The stages that a solve goes through, and about how long each takes: the basis of its progress.

Stages of the cameras consist of units of work, iterations of L-BFGS and rounds of expectation maximisation, whose cost grows with the
frames that the stage uses. Only ratios of the durations matter, because the remaining time is extrapolated from the elapsed time. Which
stages run depends on the data: one that is skipped is dropped from the plan when a later one begins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

UNIT_SECONDS, FRAME_SECONDS = 2e-4, 1.2e-5
"""Seconds per unit of work, and per unit and frame, on one core; from 10 to 357 frames."""

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
    "multistart": (1600, 120, 1.2),
    "model_order": (1000, 360, 0.6),
    "starts": (2500, 40, 1.0),
    "perspective": (17, 360, 40.0),
    "scales": (1500, 120, 1.0),
    "refinement": (700, 360, 1.0),
    "covariance": (550, 360, 1.2),
    "trust": (7, 100, 90.0),
}
"""Stages of the default prior: typical number of units, maximum number of frames used, and cost of a unit against that of an iteration."""


def planned(
    frames: int, points: int, *, gaussian: bool, known_cameras: bool, sheet: bool, units: dict[str, int] | None = None
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
    units : dict, optional
        Units of work that are known better than from `UNITS`.
    """
    names = ["multistart", "model_order", "starts", "perspective", "scales", "refinement", "covariance"]
    if not gaussian:
        names = ["multistart"]
    elif known_cameras:
        names = ["model_order", "covariance"]
    stages = [_stage(name, frames, (units or {}).get(name)) for name in names]
    if known_cameras and not gaussian:
        stages = []
    if sheet:
        stages.insert(0, Stage("surface", 0.05 * min(frames, 24) + 0.5, 20))
    shapes = Stage("shapes", SETUP_SECONDS + POINT_SECONDS * frames * points, 1000)
    last = [_stage("trust", frames, None)] if gaussian else []
    return (*stages, shapes, *last)


def expected(stage: Stage, units: int) -> Stage:
    """Return the stage with another number of units, its duration in proportion."""
    return replace(stage, units=units, seconds=stage.seconds * units / max(stage.units, 1))


def _stage(name: str, frames: int, units: int | None) -> Stage:
    count, most_frames, cost = UNITS[name]
    used = count if units is None else units
    each = cost * (UNIT_SECONDS + FRAME_SECONDS * min(frames, most_frames))
    return Stage(name, used * each, used)

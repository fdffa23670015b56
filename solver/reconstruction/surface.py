"""Isometric surfaces: test whether the tracks show one, whose solution then replaces the stages of a free surface."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from pliant.solver.errors import InvalidSettings
from pliant.solver.isometry.surface import IsometricVerdict, isometric_surface
from pliant.solver.monitor import Monitor
from pliant.solver.records import Choices, KnownCamera, Step, Tracks
from pliant.solver.settings import Settings
from pliant.solver.shapes.inliers import with_inlier_probability
from pliant.solver.shapes.isometric_solution import centre_downwards, downwards, isometric_solution
from pliant.solver.solution import Solution
from pliant.solver.tracks.normalization import normalize


def tries_isometry(cameras: KnownCamera | None, settings: Settings) -> bool:
    """Whether the tracks are tested for an isometric surface."""
    if settings.surface != "auto":
        return settings.surface == "isometric"
    # Without image size or focal length, the inconsistency I has false minima for cloth at a large distance.
    pinhole = settings.focal_length is not None or settings.image_size is not None
    return settings.gaussian and pinhole and cameras is None and settings.camera in {Settings().camera, "perspective"}


def isometric_verdict(
    tracks: Tracks, cameras: KnownCamera | None, settings: Settings, monitor: Monitor
) -> IsometricVerdict | None:
    """Return the verdict on whether the surface is isometric; None if this is not tested.

    Raises
    ------
    InvalidSettings
        An isometric surface is required, but rotations are given.
    """
    if settings.surface == "isometric" and cameras is not None:
        raise InvalidSettings(
            "invalid_option", field="options.surface", expected="auto or free where rotations are given", got="'isometric'",
            hint="Omit the rotations: an isometric surface determines its own cameras.",
        )  # fmt: skip
    if not tries_isometry(cameras, settings):
        return None
    return isometric_surface(
        downwards(tracks) if settings.y_up else tracks, focal=settings.focal_length, principal_point=centre_downwards(settings),
        image_size=settings.image_size, required=settings.surface == "isometric", should_stop=monitor,
    )  # fmt: skip


def solution_of(
    tracks: Tracks, verdict: IsometricVerdict, settings: Settings, monitor: Monitor, *, began: float
) -> Solution:
    """Return the solution of an accepted verdict; `began` is the `time.perf_counter` value at the start of the solve."""
    normalized, seconds = normalize(tracks), {"cameras": time.perf_counter() - began}
    solution = isometric_solution(
        tracks, verdict, settings, unit=normalized.unit, seconds=seconds, stopped=monitor.stopped
    )
    used = np.where(solution.weights > 0, tracks.visible, 0.0)
    monitor.report(Step("finish", 1.0, max_reweightings=settings.max_reweightings))
    return with_inlier_probability(solution, tracks, used, full_confidence=normalized.full_confidence, loss="l2")


def with_verdict(choices: Choices, verdict: IsometricVerdict, settings: Settings) -> Choices:
    """Return the choices with the reason for a free surface, and a warning if an isometric surface was required."""
    warnings = choices.warnings
    if settings.surface == "isometric":
        warnings = (*warnings, f"The surface was not accepted as isometric and is solved as free. {verdict.reason}")
    tried = tuple((each.focal, each.inconsistency) for each in verdict.candidates)
    return replace(
        choices, reasons={**choices.reasons, "surface": verdict.reason}, warnings=warnings, focal_lengths=tried
    )

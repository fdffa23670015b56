"""Isometric surfaces: test whether the tracks show one, whose solution then replaces the stages of a free surface."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from pliant.solver.evaluation.metrics import e3d_frame_scaled
from pliant.solver.evaluation.trust import Verdict
from pliant.solver.isometry.surface import IsometricVerdict, isometric_surface, sheetlike
from pliant.solver.monitor import Monitor
from pliant.solver.reconstruction.unused_settings import without_effect
from pliant.solver.records import Floats, KnownCamera, Step, Tracks
from pliant.solver.settings import Settings
from pliant.solver.shapes.inliers import with_inlier_probability
from pliant.solver.shapes.isometric_solution import centre_downwards, downwards, isometric_solution
from pliant.solver.solution import Solution
from pliant.solver.tracks.normalization import normalize

UNLIKE = 0.1
"""Minimum relative difference of the free surface from an isometric one with weak evidence for the latter to be taken. If they are alike,
the free one is, since it need not keep lengths: on a made-up sheet that tears its error is .003, and .06 as an isometric surface."""

COMPARED_POINTS = 2000
"""Approximate number of points with which they are compared."""


def tries_isometry(cameras: KnownCamera | None, settings: Settings) -> bool:
    """Whether the tracks are tested for an isometric surface."""
    if settings.surface != "auto":
        return settings.surface == "isometric"
    return _may_be_isometric(cameras, settings) and _knows_lens(settings)


def _may_be_isometric(cameras: KnownCamera | None, settings: Settings) -> bool:
    return settings.gaussian and cameras is None and settings.camera in {Settings().camera, "perspective"}


def _knows_lens(settings: Settings) -> bool:
    # Without image size or focal length, the inconsistency I has false minima for cloth at a large distance.
    return settings.focal_length is not None or settings.image_size is not None


def isometric_verdict(
    tracks: Tracks, cameras: KnownCamera | None, settings: Settings, monitor: Monitor
) -> IsometricVerdict | None:
    """Return the verdict on whether the surface is isometric; None if the question does not arise."""
    if not tries_isometry(cameras, settings):
        return _untested(tracks) if settings.surface == "auto" and _may_be_isometric(cameras, settings) else None
    return isometric_surface(
        downwards(tracks) if settings.y_up else tracks, focal=settings.focal_length, principal_point=centre_downwards(settings),
        image_size=settings.image_size, required=settings.surface == "isometric", seed=settings.seed, should_stop=monitor,
    )  # fmt: skip


def _untested(tracks: Tracks) -> IsometricVerdict | None:
    """Return the verdict on tracks whose lens is unknown; None if they do not resemble those of a sheet."""
    off = sheetlike(tracks)
    if off is None:
        return None
    return IsometricVerdict(
        "Isometry was not tested, because neither image_size nor focal is given. The pictures differ from those of a plane by "
        f"{off:.1%} of its size, as those of a sheet do.",
        warnings=(_unknown_lens_warning(),),
    )


def _unknown_lens_warning() -> str:
    return (
        "The object may be a sheet that bends, which was not tested. Give image_size or focal, so that its bending can be recovered "
        "from perspective."
    )


def solution_of(
    tracks: Tracks, verdict: IsometricVerdict, settings: Settings, monitor: Monitor, *, began: float
) -> Solution:
    """Return the solution of an accepted verdict; `began` is the `time.perf_counter` value at the start of the solve."""
    normalized, seconds = normalize(tracks), {"cameras": time.perf_counter() - began}
    solution = isometric_solution(
        tracks, verdict, settings, unit=normalized.unit, seconds=seconds, stopped=monitor.stopped
    )
    unused = without_effect(settings, isometric=True)
    solution = replace(solution, choices=replace(solution.choices, warnings=(*solution.choices.warnings, *unused)))
    used = np.where(solution.weights > 0, tracks.visible, 0.0)
    solution = with_inlier_probability(solution, tracks, used, full_confidence=normalized.full_confidence, loss="l2")
    monitor.report(Step("finish", 1.0, max_reweightings=settings.max_reweightings))
    return solution


def with_verdict(
    free: Solution, tracks: Tracks, verdict: IsometricVerdict, settings: Settings, monitor: Monitor, *, began: float
) -> Solution:
    """Return the solution of a free surface with the verdict on an isometric one, or that of the latter if it is more probable.

    Weak evidence for constant lengths counts for less than a free surface that is good: a tearing sheet, of which most edges keep their
    lengths, has an error of .019 as a free surface and .126 as an isometric one. A warning is added if an isometric surface was required.
    The warnings of the verdict are added if the free solution is not good.
    """
    choices, trust = free.choices, free.trust
    is_good = trust is not None and trust.verdict is Verdict.GOOD
    if verdict.surface is not None:
        unlike = _unlike(free.shapes, verdict.surface.points)
        if unlike >= UNLIKE and not is_good:
            warned = replace(verdict, warnings=(*verdict.warnings, _weak_evidence_warning(unlike)))
            return solution_of(tracks, warned, settings, monitor, began=began)
        reason = (
            f"Solved as a free surface, which differs from an isometric one by only {unlike:.1%} of its size."
            if unlike < UNLIKE
            else f"Solved as a free surface, whose verdict is good. The evidence for an isometric one, which differs by {unlike:.0%} of "
            "its size, is weak."
        )
        verdict = IsometricVerdict(reason, verdict.focal_lengths)
    warnings = choices.warnings
    if settings.surface == "isometric":
        warnings = (*warnings, f"The surface was not accepted as isometric and is solved as free. {verdict.reason}")
    elif not is_good:
        warnings = (*warnings, *verdict.warnings)
    reasons, tried = {**choices.reasons, "surface": verdict.reason}, verdict.focal_lengths
    return replace(free, choices=replace(choices, reasons=reasons, warnings=warnings, focal_lengths=tried))


def _unlike(free: Floats, isometric: Floats) -> float:
    """Return the relative difference of two sequences of shapes `(F, P, 3)`, each of which may be mirrored."""
    some = slice(None, None, max(1, free.shape[1] // COMPARED_POINTS))
    return e3d_frame_scaled(free[:, some], isometric[:, some])


def _weak_evidence_warning(unlike: float) -> str:
    return (
        f"The evidence for constant lengths is weak, and a free surface differs by {unlike:.0%} of the size. Solve with surface=free, too, "
        "and look at both from the side: this one suits paper and cloth, and the free one suits what stretches or tears."
    )

"""Reconstruction of a sheet that bends without stretching, seen by a pinhole camera, and of its focal length if that is not given.

The maximum-depth heuristic (`inextensible`) gives starting depths of the anchors, `refinement` makes their edge lengths constant, and
splines (`extension`) extend them to all points. The isometric inconsistency I, the relative change of the edge lengths from frame to frame,
needs no ground truth. As a function of the focal length, it has its minimum at the true one if perspective is strong enough for the method
to work; otherwise it is large or flat. Isometry is therefore accepted only if I is small and clearly smaller than at the neighbouring focal
lengths, and if halves of the frames lead to the same edge lengths (`confirmation`). The order of the frames has no effect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.evaluation.trust import size_of
from pliant.solver.isometry.anchors import choose_anchors, connected, nearest_neighbours, unlike_frames
from pliant.solver.isometry.arc_lengths import refine_along_surface
from pliant.solver.isometry.confirmation import DECISIVE, DISAGREEMENT, bending_of, disagreement
from pliant.solver.isometry.deviations import deviations_at, standard_deviations
from pliant.solver.isometry.extension import MIN_ANCHORS, Extended, complete_anchors, extend, flatten
from pliant.solver.isometry.focal_sweep import (
    CLEAR,
    FOCAL_STEP,
    FocalSearch,
    Judgement,
    Tried,
    judged,
    least_of,
    sweep,
)
from pliant.solver.isometry.homographies import off_homography
from pliant.solver.isometry.inextensible import SurfaceGraph, maximum_depth
from pliant.solver.isometry.refinement import refine
from pliant.solver.isometry.restarts import carried, refine_with_restarts, unlikeness
from pliant.solver.monitor import enter, expect_only
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, Tracks
from pliant.solver.stages import accepted_sheet, search_for_sheet
from pliant.solver.tracks.normalization import relative

ANCHORS = 60
"""Number of points in the conic program; its time grows with their number times the number of frames."""

SOLVED_FRAMES = 24
"""Number of frames used in the conic program and to compare focal lengths; the others start from the most similar one of these."""

SHEETLIKE, TESTED = 0.12, 0.17
"""Distance of the frames from homographies of a reference frame, relative to the size, up to which tracks resemble those of a sheet, and
up to which `auto` tests isometry. Measured: sheets rolled up to half a cylinder .004 to .055, paper .028 and .040 with all errors, a comic
page .042 and .052, made-up paper that the camera passes by 50° to 180° .02 to .11, and .14 to .16 where it goes all the way round; a back
.027, heads .02 to .06, one that turns by 90° .13, other bodies .065 or more. Bodies below the limit are left to the tests that follow:
with a limit of .2, none of those in `benchmarks.accuracy.kinds`, and of the recorded sequences seen from three half-sizes away, is taken as
isometric."""

HOPELESS = 0.025
"""I of the subset `SMALL_PART` at the best of `GLANCES` focal lengths above which `auto` rejects isometry. Measured: paper, a page and
flags near the camera .003 to .018, .022 at half the true focal length; most bodies .021 to .06, but shallow faces and arms less."""

SMALL_PART = (30, 12, 10)
"""Numbers of anchors, frames and neighbours in the subset of the first test."""

GLANCES = 3
"""Number of focal lengths in the first test, `FOCAL_STEP` apart: a camera near a sheet may have half the usual focal length."""

TYPICAL_FOCAL = 0.8
"""First focal length tried, in image diagonals: a diagonal angle of view of about 64°."""

DIAGONAL_MARGIN = 1.3
"""Ratio of the image diagonal to the diagonal of the tracks' bounding box, assumed if the image size is not given."""

FIRST_LOOK = 200
"""Approximate number of points used to choose dissimilar frames."""

TOO_LITTLE = "Too few points are visible in the same frames for an isometric surface."


@dataclass(frozen=True, slots=True, eq=False)
class IsometricVerdict:
    """Whether the tracks show an isometric surface, and the surface if they do."""

    reason: str
    """Sentences for the report."""

    focal_lengths: tuple[tuple[float, float], ...] = ()
    """Focal lengths in the order in which they were tried, pixels, each with its inconsistency I."""

    surface: IsometricSurface | None = None
    """None if isometry is rejected."""

    warnings: tuple[str, ...] = ()
    """Warnings for the user."""

    weak: bool = False
    """Whether the evidence decides only between this surface and a free one that differs from it."""


@dataclass(frozen=True, slots=True, eq=False)
class IsometricSurface:
    """Shapes in the axes of each frame's camera."""

    points: Floats
    """Camera axes, x right, y down, z away, shape `(F, P, 3)`; the sequence has one free scale."""

    outliers: NDArray[np.bool_]
    """Observations that contradict the surface, shape `(F, P)`."""

    placed: NDArray[np.bool_]
    """Points with a position on the surface, shape `(P,)`."""

    shown: NDArray[np.bool_]
    """Frames that show enough of the surface, shape `(F,)`; every other frame copies the shape of the nearest of these."""

    focal: float
    """Given or estimated focal length, pixels."""

    principal_point: tuple[float, float]
    """Given or assumed principal point, pixels."""

    focal_std: float | None
    """Standard deviation of an estimated focal length, pixels; None if stopped before it was computed."""

    deviations: Floats | None
    """Standard deviations of the points' positions, the same in all frames, shape `(P,)`, the unit of `points`; None as `focal_std`."""

    inconsistency: float
    """I of the anchors over all frames."""

    noise_std: float
    """Robust standard deviation of the tracks about small affine patches, the tracks' unit."""


def isometric_surface(
    tracks: Tracks,
    *,
    focal: float | None = None,
    principal_point: tuple[float, float] | None = None,
    image_size: tuple[float, float] | None = None,
    required: bool = False,
    seed: int = 0,
    should_stop: ShouldStop = never,
) -> IsometricVerdict:
    """Decide whether the tracks show an isometric surface, and reconstruct it.

    Parameters
    ----------
    tracks : Tracks
        Pixels, x right, y down. Confidences are inverse variances relative to the largest.
    focal : float, optional
        Focal length in pixels; None searches for it.
    principal_point : (x, y), optional
        Pixels; None takes the image centre, or the median of the tracks if `image_size` is not given.
    image_size : (width, height), optional
        Pixels.
    required : bool
        Return the surface, with a warning, even if the evidence is weak. The surface is None only if no surface could be computed.
    seed : int
        Of the noise with which the standard deviations are computed.
    should_stop : callable, optional
        Called between units of work. If it returns True during the search, isometry is rejected; later, refinement ends early.
    """
    if required:
        rest = accepted_sheet(tracks.num_frames, tracks.num_points)
        expect_only(should_stop, [*search_for_sheet(tracks.num_frames)[1:], *rest])
    diagonal, centre = _diagonal(tracks, image_size), _centre(tracks, principal_point, image_size)
    first = focal if focal is not None else TYPICAL_FOCAL * diagonal
    search = _search(tracks, centre, first, required, should_stop)
    if isinstance(search, str):
        return IsometricVerdict(search)

    def worthwhile(first: Tried) -> bool:
        bending = bending_of(search, first)
        return required or bending is None or not bending.rigid

    tried = sweep(search, first, diagonal, given=focal is not None, worthwhile=worthwhile)
    if search.should_stop():
        return IsometricVerdict("Stopped before the test for isometry had finished.", _trace(tried))
    if not tried:
        return IsometricVerdict("No isometric surface was found: the conic program has no solution.", _trace(tried))
    return _verdict(search, tracks, tried, focal, required, seed)


def _search(tracks: Tracks, centre: Floats, focal: float, required: bool, should_stop: ShouldStop) -> FocalSearch | str:
    """Return the anchors of all frames, or the reason why dissimilar frames at one focal length exclude an isometric sheet."""
    confidence = relative(tracks.visible, float(tracks.visible.max()))
    part = _some_frames(tracks.points, confidence > 0)
    search = _prepared(tracks.points[part], confidence[part], centre, should_stop)
    against = _implausible(search, focal, required)
    if against is None and len(part) < tracks.num_frames:
        enter(should_stop, "anchors")
        search = _prepared(tracks.points, confidence, centre, should_stop)
        should_stop()
        enter(should_stop, "surface")
    return against or search or TOO_LITTLE


def _unrecognised_warning() -> str:
    return (
        "The object was not recognised as a sheet that keeps its lengths, such as paper or cloth seen from nearby. If it is one, try "
        "surface=isometric and compare."
    )


def _verdict(
    search: FocalSearch, tracks: Tracks, tried: list[Tried], focal: float | None, required: bool, seed: int
) -> IsometricVerdict:
    """Return the verdict on the surface at the given focal length, or at the best of those tried."""
    least = least_of(tried)
    judgement, chosen = judged(tried, least), least if focal is None else tried[0]
    bending = bending_of(search, chosen)
    if not required and bending is not None and bending.rigid:
        return IsometricVerdict(bending.words, _trace(tried))
    supported, why = _confirmed(search, chosen, judgement) if judgement.ratio > 0 else (False, judgement.words)
    if not supported and not required:
        advice = "If it is one that keeps its lengths, such as paper or cloth seen from nearby, try surface=isometric and compare."
        reason = f"Rejected as an isometric sheet: {why}. {advice}"
        return IsometricVerdict(reason, _trace(tried), warnings=(_unrecognised_warning(),))
    if bending is None and not required:
        return IsometricVerdict(TOO_LITTLE, _trace(tried))
    warnings = _warnings(None if supported else why, focal, least, chosen)
    if not supported:
        why = f"Solved as an isometric sheet, as set, although {why}."
    if judgement.clear or required:
        expect_only(search.should_stop, accepted_sheet(tracks.num_frames, tracks.num_points))
    surface = _everywhere(search, tracks, chosen, seed)
    if surface is None:
        return IsometricVerdict("No isometric surface was found: its points are not connected.", _trace(tried))
    return IsometricVerdict(why, _trace(tried), surface, warnings, weak=not (judgement.clear or required))


def sheetlike(tracks: Tracks) -> float | None:
    """Return how far the pictures differ from those of a plane, relative to its size, if that is as little as for a sheet, else None.

    Needs neither focal length nor principal point.
    """
    confidence = relative(tracks.visible, float(tracks.visible.max()))
    part = _some_frames(tracks.points, confidence > 0)
    search = _prepared(tracks.points[part], confidence[part], np.zeros(2), never)
    off = float("inf") if search is None else off_homography(search.anchors.points, search.anchors.seen)
    return off if off <= SHEETLIKE else None


def _implausible(search: FocalSearch | None, focal: float, required: bool) -> str | None:
    """Return the reason why the tracks cannot show an isometric sheet; None if they may."""
    if search is None:
        return TOO_LITTLE
    if required:
        return None
    off = off_homography(search.anchors.points, search.anchors.seen)
    if off > TESTED:
        return f"Isometry was not tested: the pictures differ from those of a plane by {off:.1%} of its size."
    changes = _glance(search, focal)
    return (
        f"Not an isometric sheet: edge lengths of some of its points change by {changes:.1%}."
        if changes > HOPELESS
        else None
    )


def _confirmed(search: FocalSearch, chosen: Tried, judgement: Judgement) -> tuple[bool, str]:
    """Return whether halves of the frames lead to the same edge lengths, with a sentence; else a clause why not.

    The weaker the evidence of the focal lengths, the better they must agree.
    """
    share = disagreement(search, chosen)
    if share <= (DISAGREEMENT if judgement.clear else min(DISAGREEMENT, (judgement.ratio - 1) / DECISIVE)):
        return True, f"{judgement.words} Halves of the frames agree on the lengths to within {share:.1%}."
    if not judgement.clear and share <= DISAGREEMENT:
        return False, "its edge lengths hardly single out a focal length"
    change = "by more than their length" if share > 1 else f"by {share:.0%}"
    return False, f"its edge lengths differ {change} between halves of the frames"


def _some_frames(points: Floats, seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return dissimilar frames for the first test, chosen with about `FIRST_LOOK` points."""
    often = np.argsort(-seen.sum(axis=0), kind="stable")[:: max(1, seen.shape[1] // FIRST_LOOK)]
    return unlike_frames(points[:, often], seen[:, often], SOLVED_FRAMES)


def _prepared(points: Floats, confidence: Floats, centre: Floats, should_stop: ShouldStop) -> FocalSearch | None:
    if ((confidence > 0).sum(axis=0) >= 2).sum() < MIN_ANCHORS:
        return None
    anchors = choose_anchors(points, confidence, ANCHORS)
    if anchors.points.shape[1] < MIN_ANCHORS:
        return None
    edges = nearest_neighbours(anchors.points, anchors.seen)
    if len(edges) == 0:
        return None
    known = connected(anchors.seen, edges)
    # Fewer anchors do not determine their depths, which would distort the lengths of all frames.
    known &= known.sum(axis=1, keepdims=True) >= MIN_ANCHORS
    if known.any(axis=1).sum() < 2:
        return None
    frames = unlike_frames(anchors.points, known, SOLVED_FRAMES)
    return FocalSearch(anchors, edges, known, frames, centre, should_stop)


def _glance(search: FocalSearch, focal: float) -> float:
    """Return the least I of the subset `SMALL_PART` at a focal length and shorter ones; infinite if there is no surface."""
    some, frames, neighbours = SMALL_PART
    seen = search.seen[:, :some]
    edges = nearest_neighbours(search.anchors.points[:, :some], seen, neighbours=neighbours)
    anchors = search.anchors
    part = replace(
        search,
        anchors=replace(anchors, points=anchors.points[:, :some], confidence=anchors.confidence[:, :some]),
        edges=edges,
        seen=connected(seen, edges),
        frames=search.frames[:frames],
    )
    begun = part.begun(focal)
    if begun is None:
        return float("inf")
    tried = [(begun.solved(each), begun.start(each)) for each in focal / FOCAL_STEP ** np.arange(GLANCES)]
    return min(refine(graph, depths, iterations=10).inconsistency for graph, depths in tried if depths is not None)


def _everywhere(search: FocalSearch, tracks: Tracks, chosen: Tried, seed: int) -> IsometricSurface | None:
    """Return the surface in all frames and points at the chosen focal length, or None if the anchors are not connected."""
    enter(search.should_stop, "sheet")
    part = chosen.graph
    whole = search.graph(chosen.focal)
    afresh = maximum_depth(part, should_stop=search.should_stop)
    found = chosen.found if afresh is None else refine_with_restarts(part, afresh, should_stop=search.should_stop)
    found = min(found, chosen.found, key=lambda each: each.inconsistency)
    if len(search.frames) < tracks.num_frames:
        enter(search.should_stop, "sheet_frames")
        found = refine_with_restarts(whole, _from_similar(whole, search, found.depths), should_stop=search.should_stop)
    found = refine_along_surface(whole, found, should_stop=search.should_stop)
    template = flatten(search.edges, found.lengths, search.seen.shape[1])
    if template is None:
        return None
    points, enough = complete_anchors(found.depths[..., None] * whole.rays, search.seen, template)
    if not enough.any():
        return None
    enter(search.should_stop, "sheet_points")
    all_of_it: Extended = extend(
        tracks.points, relative(tracks.visible, float(tracks.visible.max())), images=search.anchors.points, known=search.seen,
        anchors=points, template=template, focal=chosen.focal, centre=search.centre,
        noise_std=search.anchors.noise_std if search.anchors.denoised else 0.0,
    )  # fmt: skip
    if not np.isfinite(all_of_it.points).all():
        return None
    enter(search.should_stop, "sheet_error")
    shown = search.frames[enough[search.frames]]
    if len(shown) == 0:
        shown = np.flatnonzero(enough)[:SOLVED_FRAMES]
    deviations = standard_deviations(whole, found, points, shown, seed=seed, should_stop=search.should_stop)
    return IsometricSurface(
        all_of_it.points, all_of_it.outliers, all_of_it.placed, enough, chosen.focal,
        (float(search.centre[0]), float(search.centre[1])),
        None if deviations is None else chosen.focal * deviations.focal,
        None if deviations is None else deviations_at(
            all_of_it.places, all_of_it.placed, deviations.points, template=template, size=size_of(points)
        ),
        found.inconsistency, search.anchors.noise_std,
    )  # fmt: skip


def _from_similar(graph: SurfaceGraph, search: FocalSearch, depths: Floats) -> Floats:
    """Return starting depths `(F, A)` of all frames, copied from the solved frame with the most similar image."""
    return carried(depths[unlikeness(graph, search.frames).argmin(axis=0)], graph)


def _centre(
    tracks: Tracks, principal_point: tuple[float, float] | None, image_size: tuple[float, float] | None
) -> Floats:
    if principal_point is not None:
        return np.array(principal_point, dtype=np.float64)
    if image_size is not None:
        return (np.array(image_size, dtype=np.float64) - 1) / 2
    return np.asarray(np.median(tracks.points[tracks.visible > 0], axis=0))


def _diagonal(tracks: Tracks, image_size: tuple[float, float] | None) -> float:
    """Return the image diagonal, estimated from the middle 98 % of the tracks if the size is not given."""
    if image_size is not None:
        return float(np.hypot(*image_size))
    low, high = np.quantile(tracks.points[tracks.visible > 0], [0.01, 0.99], axis=0)
    return DIAGONAL_MARGIN * float(np.hypot(*(high - low)))


def _warnings(doubt: str | None, focal: float | None, least: Tried, chosen: Tried) -> tuple[str, ...]:
    """Return the warnings for a surface that is taken; `doubt` is a clause that says why it would not be taken if it were not required."""
    warnings = []
    if doubt is not None:
        warnings.append(
            f"The surface was required to be isometric, but the tracks hardly support it: {doubt}. Solve with surface=free, too, and "
            "look at both from the side: this one suits paper and cloth, and the free one suits what stretches or tears."
        )
    if focal is not None and chosen.found.inconsistency > CLEAR * least.found.inconsistency:
        warnings.append(
            f"The given focal length of {focal:.0f} px is improbable: edge lengths change {chosen.found.inconsistency:.2%} with it, "
            f"{least.found.inconsistency:.2%} at {least.focal:.0f} px. Check focal, field_of_view and principal_point."
        )
    return tuple(warnings)


def _trace(tried: list[Tried]) -> tuple[tuple[float, float], ...]:
    return tuple((each.focal, each.found.inconsistency) for each in tried)

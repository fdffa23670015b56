"""Whether frames come in the order of a film, and an order of their own for photographs.

If a point's image walks from frame to frame, its step has variance s² given the frame before; if frames are independent, its image has
variance v about the mean, and two frames differ by 2v. The walk is the more probable of the two where s² < v: where the squared
difference of neighbouring frames is less than half of that of any two frames. The difference of two frames is the mean over the points or
their median, whichever shows a walk: gross outliers, which differ as much between neighbours as between any frames, decide a mean, and
points that stand still a median.

Photographs in no order are put in an order that follows from their content, so that nothing depends on the order that they came in: each
frame is followed by the most similar one that is left.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.errors import InvalidSettings
from pliant.solver.records import Camera, Floats, KnownCamera, Tracks, read_only
from pliant.solver.settings import Settings
from pliant.solver.solution import Solution
from pliant.solver.tracks.frame_selection import evenly_spread
from pliant.solver.tracks.noise import weighted_median

WALK_SHARE = 0.5
"""Squared difference of neighbouring frames over that of any two below which the walk is more probable; see above. Recorded films, with up
to 20 % gross outliers, have at most .40, photographs and shuffled films at least .74."""

MAX_PAIRS, MAX_POINTS = 200, 2000
"""Maximum numbers of pairs of frames and of points that are compared; they bound time and memory."""

MAX_UNORDERED_FRAMES = 360
"""Maximum number of photographs: all of them are learned from, since between photographs nothing can be interpolated
(`limits.LEARNED_FRAMES`)."""


def resolved_order(tracks: Tracks, settings: Settings) -> tuple[Settings, str]:
    """Return the settings with `order` `film` or `any`, and a sentence.

    Raises
    ------
    InvalidSettings
        `any` with more than `MAX_UNORDERED_FRAMES` frames.
    """
    if settings.order == "any" and tracks.num_frames > MAX_UNORDERED_FRAMES:
        raise InvalidSettings(
            "invalid_option", field="options.order", expected=f"film or auto with more than {MAX_UNORDERED_FRAMES} frames",
            got=f"'any' with {tracks.num_frames}", hint="Select some of the photographs with the option frames.",
        )  # fmt: skip
    if settings.order != "auto":
        return settings, f"Frames in {'the order of a film' if settings.order == 'film' else 'no order'}, as set."
    share = step_share(tracks)
    found = (
        f"neighbouring frames differ by {share:.2f} of what any two frames differ by, squared; the walk of a film is more probable "
        f"below {WALK_SHARE:g}"
    )
    if share < WALK_SHARE or not np.isfinite(share):
        return replace(settings, order="film"), f"Frames in the order of a film: {found}."
    if not settings.gaussian or tracks.num_frames > MAX_UNORDERED_FRAMES:
        why = (
            "other priors than gaussian need it" if not settings.gaussian else "there are too many frames for no order"
        )
        return replace(settings, order="film"), f"Frames in the order of a film, since {why}: {found}."
    return replace(settings, order="any"), f"Frames in no order: {found}."


def differences(tracks: Tracks) -> Floats:
    """Return the mean squared difference of the images of every two frames, each about its centroid, shape `(F, F)`.

    Points count by the product of their confidences; infinite where two frames have no point in common.
    """
    weight = tracks.visible
    total = np.maximum(weight.sum(axis=1), np.finfo(float).tiny)
    centre = np.einsum("fp,fpc->fc", weight, tracks.points) / total[:, None]
    points = np.where(weight[..., None] > 0, tracks.points - centre[:, None], 0.0)
    squared = (weight * np.square(points).sum(axis=2)) @ weight.T
    inner = sum((weight * points[..., axis]) @ (weight * points[..., axis]).T for axis in (0, 1))
    common = weight @ weight.T
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(common > 0, np.maximum(squared + squared.T - 2 * inner, 0.0) / common, np.inf)
    np.fill_diagonal(found, 0.0)
    return np.asarray(found)


def step_share(tracks: Tracks) -> float:
    """Return the squared difference of neighbouring frames over that of any two; NaN where nothing moves or can be compared.

    Differences are averaged over pairs of frames. Of two frames it is the mean or the median over their common points, weighted by the
    products of their confidences; the smaller of the two results is returned.
    """
    every = -(-tracks.num_points // MAX_POINTS)
    points, weight = tracks.points[:, ::every], tracks.visible[:, ::every]
    first, second = np.triu_indices(tracks.num_frames, 1)
    some, steps = evenly_spread(len(first), MAX_PAIRS), evenly_spread(tracks.num_frames - 1, MAX_PAIRS)
    any_two = _typical(points, weight, zip(first[some], second[some], strict=True))
    neighbours = _typical(points, weight, zip(steps, steps + 1, strict=True))
    shares = [near / far for near, far in zip(neighbours, any_two, strict=True) if far > 0]
    return min(shares, default=float("nan"))


def _typical(points: Floats, weight: Floats, pairs: Iterable[tuple[int, int]]) -> tuple[float, float]:
    """Return mean and median over points of the squared difference, averaged over the pairs with points in common; NaN if none has.

    The median motion of the points between two frames does not count.
    """
    found = []
    for first, second in pairs:
        trust = weight[first] * weight[second]
        common = trust > 0
        if common.any():
            moved = points[first, common] - points[second, common]
            squared = np.square(moved - np.median(moved, axis=0)).sum(axis=1)
            found.append((np.average(squared, weights=trust[common]), weighted_median(squared, trust[common])))
    mean, median = np.mean(found, axis=0) if found else (np.nan, np.nan)
    return float(mean), float(median)


def content_order(between: Floats) -> NDArray[np.intp]:
    """Return the frames in an order of their own: first the one that differs most from the others, then always the most similar one."""
    finite = np.where(np.isfinite(between), between, 2 * np.max(between, where=np.isfinite(between), initial=1.0))
    order = [int(finite.sum(axis=1).argmax())]
    left = np.ones(len(finite), dtype=bool)
    left[order[0]] = False
    while left.any():
        order.append(int(np.where(left, finite[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order, dtype=np.intp)


def in_order(tracks: Tracks, cameras: KnownCamera | None, order: NDArray[np.intp]) -> tuple[Tracks, KnownCamera | None]:
    """Return tracks and cameras with their frames in another order."""
    moved = Tracks.from_arrays(tracks.points[order], tracks.visible[order])
    if cameras is None:
        return moved, None
    scales = None if cameras.scales is None else cameras.scales[order]
    return moved, replace(cameras, rotations=cameras.rotations[order], scales=scales)


def as_they_came(solution: Solution, order: NDArray[np.intp]) -> Solution:
    """Return the solution of frames that were put in this order with its frames as they came; the world axes stay."""
    back = np.argsort(order)

    def moved(values: Floats) -> Floats:
        result = np.ascontiguousarray(values[back])
        read_only(result)
        return result

    camera: Camera = replace(
        solution.camera,
        rotations=moved(solution.camera.rotations),
        scales=moved(solution.camera.scales),
        translations=moved(solution.camera.translations),
    )
    return replace(
        solution,
        shapes=moved(solution.shapes),
        camera=camera,
        residuals=moved(solution.residuals),
        weights=moved(solution.weights),
        shapes_std=None if solution.shapes_std is None else moved(solution.shapes_std),
        inlier_probability=None if solution.inlier_probability is None else moved(solution.inlier_probability),
    )

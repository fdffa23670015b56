"""Test of whether frames come in the order of a film, and an order by content for unordered photographs.

In a film, the image of a point is a random walk: its step from the previous frame has variance s². In independent frames it has variance v
about its mean, and two frames differ by 2v. The walk is more probable if s² < v, that is, if the squared difference of neighbouring frames
is less than half that of any two frames. The difference of two frames is the mean or the median over the points, whichever gives the
smaller ratio: gross outliers, which differ as much between neighbours as between any frames, dominate the mean, and static points the
median.

Unordered photographs are sorted by content, so that the result does not depend on the given order: each frame is followed by the most
similar remaining one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.limits import MAX_UNORDERED_FRAMES
from pliant.solver.records import Camera, Floats, KnownCamera, Tracks
from pliant.solver.settings import Settings
from pliant.solver.solution import Solution
from pliant.solver.tracks.frame_selection import evenly_spread
from pliant.solver.tracks.noise import weighted_median

WALK_SHARE = 0.5
"""Ratio of the squared difference of neighbouring frames to that of any two frames below which the walk is more probable. Recorded films
with up to 20 % gross outliers have at most .40, photographs and shuffled films at least .74."""

MAX_PAIRS, MAX_POINTS = 200, 2000
"""Maximum numbers of frame pairs and of points compared; they bound time and memory."""


def resolved_order(tracks: Tracks, settings: Settings) -> tuple[Settings, str]:
    """Return the settings with `order` resolved to `film` or `any`, and the reason as a sentence."""
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
            "other priors than gaussian need it" if not settings.gaussian else "there are too many frames for order any"
        )
        return replace(settings, order="film"), f"Frames in the order of a film, since {why}: {found}."
    return replace(settings, order="any"), f"Frames in no order: {found}."


def differences(tracks: Tracks) -> Floats:
    """Return the mean squared difference between the points of every two frames, relative to their centroids, shape `(F, F)`.

    Points are weighted by the product of their confidences; the value is infinite if two frames have no point in common.
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
    """Return the ratio of the squared difference of neighbouring frames to that of any two; NaN if nothing moves or is comparable.

    Differences are averaged over pairs of frames. The difference of two frames is the mean or the median over their common points, weighted
    by the products of the confidences; the smaller of the two ratios is returned.
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
    """Return mean and median over points of the squared difference, averaged over the pairs with common points; NaN if there are none.

    The median motion of the points between the two frames is subtracted first.
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
    """Return an order by content: first the frame that differs most from the others, then always the most similar remaining one."""
    finite = np.where(np.isfinite(between), between, 2 * np.max(between, where=np.isfinite(between), initial=0.0))
    order = [int(finite.sum(axis=1).argmax())]
    left = np.ones(len(finite), dtype=bool)
    left[order[0]] = False
    while left.any():
        order.append(int(np.where(left, finite[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order, dtype=np.intp)


def in_order(tracks: Tracks, cameras: KnownCamera | None, order: NDArray[np.intp]) -> tuple[Tracks, KnownCamera | None]:
    """Return tracks and cameras with their frames in the given order."""
    moved = Tracks.from_arrays(tracks.points[order], tracks.visible[order])
    if cameras is None:
        return moved, None
    scales = None if cameras.scales is None else cameras.scales[order]
    return moved, replace(cameras, rotations=cameras.rotations[order], scales=scales)


def as_they_came(solution: Solution, order: NDArray[np.intp]) -> Solution:
    """Return the solution with its frames back in the original order; `order` is the one they were solved in."""
    back = np.argsort(order)

    def moved(values: Floats) -> Floats:
        return np.ascontiguousarray(values[back])

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

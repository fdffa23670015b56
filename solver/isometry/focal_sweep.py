"""Search of the focal length by the isometric inconsistency, and the rule by which isometry is accepted.

The inconsistency I is the share of the edges' length that changes from frame to frame. As a function of the focal length it has its
minimum at the true one wherever perspective is strong enough, and is flat, large or monotone elsewhere. Each focal length starts from
the depths of a neighbouring one, the first from the conic program.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.isometry.anchors import Anchors
from pliant.solver.isometry.inextensible import SurfaceGraph, maximum_depth
from pliant.solver.isometry.refinement import Isometry, refine
from pliant.solver.records import Floats

MAX_INCONSISTENCY = 0.012
"""Largest I that is accepted. Measured: paper .002 and, with 1 px of noise, .003; a comic page .005; faces, bodies .035 to .07."""

CLEAR = 1.25
"""How many times larger I must be at the neighbouring focal lengths. Measured: paper and page 1.8 to 2.9; faces at most 1.1."""

RISE = 0.002
"""By how much I must be larger at the neighbouring focal lengths. Measured: paper and page .003 to .006; a shallow face seen without
perspective, which some false focal length bends into an isometric one, at most .0008."""

DIP = 0.8
"""Going away from the least, I must not fall below this share of what it was: several minima are no evidence."""

FOCAL_STEP = 1.5
"""Ratio of neighbouring focal lengths."""

FOCAL_RANGE = (0.2, 6.0)
"""Focal lengths searched, over the image's diagonal."""

GOLDEN_STEPS = 4
"""Golden-section steps within the bracket, which leave 6 % of uncertainty either way before the parabola."""


@dataclass(frozen=True, slots=True, eq=False)
class FocalSearch:
    """What stays the same for all focal lengths."""

    anchors: Anchors
    edges: NDArray[np.intp]
    """Between anchors, shape `(E, 2)`."""

    seen: NDArray[np.bool_]
    """Anchors' observations that hang together in their frame, shape `(F, A)`."""

    frames: NDArray[np.intp]
    """Frames that are compared."""

    centre: Floats
    """Principal point, shape `(2,)`."""

    should_stop: Callable[[], bool] | None

    @property
    def stopped(self) -> bool:
        """Whether to end."""
        return self.should_stop is not None and self.should_stop()

    def graph(self, focal: float, frames: NDArray[np.intp] | slice = slice(None)) -> SurfaceGraph:
        """Return the rays and edges of some frames at a focal length."""
        rays = (self.anchors.points[frames] - self.centre) / focal
        rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
        return SurfaceGraph(rays, self.seen[frames], self.edges)


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A focal length and the isometry found with it."""

    focal: float
    found: Isometry


def sweep(search: FocalSearch, focal: float, diagonal: float, *, given: bool) -> list[Tried]:
    """Return the focal lengths tried: the given or typical one, downhill by `FOCAL_STEP`, and, unless `given`, within the bracket."""
    first = tried_at(search, focal, None)
    if first is None:
        return []
    tried = [first]
    low, high = FOCAL_RANGE[0] * diagonal, FOCAL_RANGE[1] * diagonal
    while not search.stopped:
        least = min(tried, key=lambda each: each.found.inconsistency)
        ahead = [least.focal * FOCAL_STEP, least.focal / FOCAL_STEP]
        wanted = [f for f in ahead if low <= f <= high and not any(abs(np.log(t.focal / f)) < 1e-6 for t in tried)]
        if not wanted:
            break
        tried += [each for each in (tried_at(search, f, least) for f in wanted) if each is not None]
    values = [each.found.inconsistency for each in tried]
    if not given and max(values) - min(values) >= RISE:
        tried += _golden(search, min(tried, key=lambda each: each.found.inconsistency))
        least = min(tried, key=lambda each: each.found.inconsistency)
        for side in (-1, 1):  # the search may have moved away from the neighbours it began with
            if not any(side * np.log(t.focal / least.focal) >= 0.9 * np.log(FOCAL_STEP) for t in tried):
                further = tried_at(search, least.focal * FOCAL_STEP**side, least)
                tried += [further] if further is not None else []
    return tried


def _golden(search: FocalSearch, middle: Tried) -> list[Tried]:
    """Return what golden-section search tries within a step of the least focal length, and the vertex of a parabola at the end."""
    share = (np.sqrt(5) - 1) / 2
    low, high = np.log(middle.focal / FOCAL_STEP), np.log(middle.focal * FOCAL_STEP)
    made: list[Tried] = []

    def at(place: float) -> float:
        found = tried_at(search, float(np.exp(place)), middle)
        if found is not None:
            made.append(found)
        return found.found.inconsistency if found is not None else np.inf

    left, right = high - share * (high - low), low + share * (high - low)
    at_left, at_right = at(left), at(right)
    for _ in range(GOLDEN_STEPS - 2):
        if search.stopped:
            return made
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - share * (high - low)
            at_left = at(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + share * (high - low)
            at_right = at(right)
    around = sorted([middle, *made], key=lambda each: each.focal)
    best = min(range(len(around)), key=lambda index: around[index].found.inconsistency)
    if 0 < best < len(around) - 1:
        three = around[best - 1 : best + 2]
        x, y = np.log([t.focal for t in three]), np.square([t.found.inconsistency for t in three])
        bend, slope, _ = np.polyfit(x - x[1], y, 2)
        if bend > 0:
            at(float(np.clip(x[1] - slope / (2 * bend), x[0], x[2])))
    return made


def tried_at(search: FocalSearch, focal: float, near: Tried | None) -> Tried | None:
    """Return the isometry at a focal length, from a neighbouring one's depths or from the conic program."""
    graph = search.graph(focal, search.frames)
    if near is None:
        depths = maximum_depth(graph, should_stop=search.should_stop)
    else:
        depths = _carried(near.found.depths, graph.seen, focal / near.focal)
    return Tried(focal, refine(graph, depths, should_stop=search.should_stop)) if depths is not None else None


def _carried(depths: Floats, seen: NDArray[np.bool_], ratio: float) -> Floats:
    """Return depths for a focal length `ratio` times as long: the same relief, further away."""
    mean = depths.sum(axis=1, keepdims=True) / np.maximum(seen.sum(axis=1, keepdims=True), 1)
    return np.where(seen, np.maximum(ratio * mean + (depths - mean), 0.05 * ratio * mean), 0.0)


def judged(tried: list[Tried], least: Tried) -> tuple[bool, str]:
    """Return whether I is small and clearly smaller than at the neighbouring focal lengths, and the sentence."""
    value = least.found.inconsistency
    sides = [
        min((t.found.inconsistency for t in tried if (t.focal - least.focal) * side > 0
             and abs(np.log(t.focal / least.focal)) >= 0.9 * np.log(FOCAL_STEP)), default=0.0)
        for side in (-1, 1)
    ]  # fmt: skip
    ratio = min(sides) / value if value > 0 else np.inf
    if value > MAX_INCONSISTENCY:
        return False, f"Not an isometric sheet: edge lengths change by {value:.1%} or more, whatever the focal length."
    if not (ratio >= CLEAR and min(sides) - value >= RISE and _single(tried, least)):
        return False, "Not taken as an isometric sheet: its edge lengths do not single out a focal length."
    return True, (
        f"Taken as an isometric sheet: at a focal length of {least.focal:.0f} px edge lengths change by {value:.2%}, "
        f"{ratio:.1f} times as much at neighbouring focal lengths."
    )


def _single(tried: list[Tried], least: Tried) -> bool:
    """Return whether I rises on both sides of its minimum."""
    for side in (-1, 1):
        away = sorted((t for t in tried if (t.focal - least.focal) * side > 0), key=lambda each: side * each.focal)
        values = np.array([each.found.inconsistency for each in away])
        if bool((values < DIP * np.maximum.accumulate(values)).any()):
            return False
    return True

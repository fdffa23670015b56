"""Search for the focal length by the isometric inconsistency, and the criteria for accepting isometry.

The inconsistency I is the relative change of the edge lengths from frame to frame. As a function of the focal length, it has its minimum at
the true one if perspective is strong enough; otherwise it is flat, large or monotone. Each focal length starts from the depths of a
neighbouring one, the first from the conic program. Lengths are those along the surface (`arc_lengths`). Surfaces that are stretched along
the viewing rays are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.isometry.anchors import Anchors
from pliant.solver.isometry.arc_lengths import ROUNDS, arc_chord_ratios
from pliant.solver.isometry.inextensible import SurfaceGraph, maximum_depth
from pliant.solver.isometry.refinement import Isometry, refine
from pliant.solver.isometry.restarts import refine_with_restarts
from pliant.solver.pulse import ShouldStop
from pliant.solver.records import Floats

MAX_INCONSISTENCY = 0.012
"""Maximum I of an isometric surface. Measured: paper .002 and, with 1 px of noise, .003; a comic page .005; flags that bend
strongly .008 to .0113; faces, bodies .035 to .07."""

CLEAR = 1.25
"""Minimum ratio of I at the neighbouring focal lengths to the minimum. Measured: paper and page 1.8 to 2.9, flags 1.26 to
1.96; faces at most 1.1."""

RISE = 0.002
"""Minimum increase of I at the neighbouring focal lengths. Measured: paper and page .003 to .006; a shallow face seen without perspective,
which a false focal length can make isometric, at most .0008."""

HINT = 1.03
"""The same ratio below which a minimum is no evidence at all. Between it and `CLEAR`, or with a smaller increase than `RISE`, the minimum
is weak evidence, which `confirmation` weighs."""

DIP = 0.8
"""Minimum ratio of I to its running maximum with growing distance from the minimum: several minima are no evidence."""

MAX_DEPTH_RATIO = 30.0
"""Maximum ratio of the depths of the farthest and of the nearest point in a frame. Points near the camera keep any lengths constant with
few others. A limit of 10 excludes neighbours of the true focal length of paper 1.5 half-sizes away."""

MAX_DEPTH_SHARE = 0.5
"""Maximum share of depth differences in the squared edge lengths of a frame: that of a plane seen from its edge, with edges in all
directions. Depths that differ by more keep any lengths constant, because they dominate them: I has false minima there. Measured, in the
frame with the least share: paper and flags .02 to .15, paper seen from its edge at half to twice the true focal length up to .49; faces,
and paper without perspective, in false minima .66 to .97."""

FOCAL_STEP = 1.5
"""Ratio of neighbouring focal lengths."""

FOCAL_RANGE = (0.2, 6.0)
"""Range of focal lengths searched, in image diagonals. The search may end one step beyond it, to bracket a minimum near its ends."""

GOLDEN_STEPS = 4
"""Evaluations of golden-section search, which narrow the bracket to about ±10 % before the parabola is fitted."""


@dataclass(frozen=True, slots=True, eq=False)
class FocalSearch:
    """Data common to all focal lengths."""

    anchors: Anchors
    edges: NDArray[np.intp]
    """Edges between anchors, shape `(E, 2)`."""

    seen: NDArray[np.bool_]
    """Mask of the visible anchors in the largest connected component of their frame, shape `(F, A)`."""

    frames: NDArray[np.intp]
    """Frames used to compare focal lengths."""

    centre: Floats
    """Principal point, shape `(2,)`."""

    should_stop: ShouldStop

    arc_ratios: Floats | None = None
    """`SurfaceGraph.arc_ratios` of `frames`, the same for all focal lengths; None if unknown."""

    deepest: tuple[float, Floats] | None = None
    """Depths of the conic program, shape `(F, A)`, and the focal length they were found at; None before it is solved."""

    def begun(self, focal: float) -> FocalSearch | None:
        """Return the search with the depths of the conic program at a focal length; None if the program has no solution."""
        depths = maximum_depth(self.solved(focal), should_stop=self.should_stop)
        return None if depths is None else replace(self, deepest=(focal, depths))

    def start(self, focal: float) -> Floats | None:
        """Return the depths of the conic program for another focal length, shape `(F, A)`; None before it is solved."""
        if self.deepest is None:
            return None
        origin, depths = self.deepest
        return refocused(depths, self.solved(focal).seen, focal / origin)

    def solved(self, focal: float) -> SurfaceGraph:
        """Return the rays and edges of `frames` at a focal length."""
        return replace(self.graph(focal, self.frames), arc_ratios=self.arc_ratios)

    def graph(self, focal: float, frames: NDArray[np.intp] | slice = slice(None)) -> SurfaceGraph:
        """Return the rays and edges of the given frames at a focal length."""
        rays = (self.anchors.points[frames] - self.centre) / focal
        rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
        return SurfaceGraph(rays, (self.anchors.confidence * self.seen)[frames], self.edges)


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A focal length and the isometry found with it."""

    focal: float

    graph: SurfaceGraph
    """Rays and edges of the `frames` of the search at this focal length."""

    found: Isometry


def sweep(
    search: FocalSearch,
    focal: float,
    diagonal: float,
    *,
    given: bool,
    worthwhile: Callable[[Tried], bool] = lambda _: True,
) -> list[Tried]:
    """Return the isometries tried: downhill from the first focal length by `FOCAL_STEP`, at most one step beyond `FOCAL_RANGE`.

    A given focal length is tried first and kept. Others are left out if the surface is stretched there: the search starts with the next
    shorter ones, since the first may be far too long.

    Distances between the ends of edges vary where the surface bends. They make focal lengths that are too long more consistent, since the
    surface bends less there, so lengths along the surface are needed before longer ones are tried. Unless `given`, the bracket of the
    minimum is then searched, if a minimum there could be accepted. If the first isometry is not `worthwhile`, no other is tried.
    """
    # A given focal length may be outside the range.
    ends = min(FOCAL_RANGE[0] * diagonal, focal), max(FOCAL_RANGE[1] * diagonal, focal)
    begun = search.begun(focal)
    first = None if begun is None else _first(begun, focal, shortest=focal if given else ends[0])
    if begun is None or first is None:
        return []
    if not worthwhile(first):
        return [first]
    search = begun
    tried = _downhill(search, [first], ends, sides=(-1,))
    for _ in range(ROUNDS):
        along_surface, refined = _along_surface(search, tried)
        kept = [each for each in refined if (given and each.focal == focal) or not _stretched(each.graph, each.found)]
        if kept:
            search, tried = along_surface, kept
        tried = _downhill(search, tried, ends)
    if not given and _may_be_accepted(tried, ends):
        tried += _golden(search, least_of(tried))
        # The new minimum may lack a neighbour at the distance of a step.
        tried += _beside(search, tried, least_of(tried))
    return tried


def _first(search: FocalSearch, focal: float, shortest: float) -> Tried | None:
    """Return the isometry at a focal length, or at the longest of the shorter ones where it is not stretched, if there is one."""
    first = found = tried_at(search, focal, None)
    while found is not None and _stretched(found.graph, found.found):
        if found.focal <= shortest or search.should_stop():
            return first
        found = tried_at(search, found.focal / FOCAL_STEP, None)
    return found


def _downhill(
    search: FocalSearch, tried: list[Tried], ends: tuple[float, float], *, sides: tuple[int, ...] = (1, -1)
) -> list[Tried]:
    """Return the isometries tried, continued downhill from the least I towards longer (1) and shorter (−1) focal lengths."""
    while not search.should_stop():
        least = least_of(tried)
        if not ends[0] <= least.focal <= ends[1]:
            break
        further = _beside(search, tried, least, sides)
        if not further:
            break
        tried = [*tried, *further]
    return tried


def _along_surface(search: FocalSearch, tried: list[Tried]) -> tuple[FocalSearch, list[Tried]]:
    """Return the search and the isometries tried, with lengths along the surface that has the least I.

    All focal lengths share them: their own would make a surface that is stretched along the viewing rays consistent.
    """
    least = least_of(tried)
    search = replace(search, arc_ratios=arc_chord_ratios(least.graph, least.found))
    graphs = [search.solved(each.focal) for each in tried]
    return search, [
        Tried(each.focal, graph, refine(graph, each.found.depths, should_stop=search.should_stop))
        for each, graph in zip(tried, graphs, strict=True)
    ]


def _may_be_accepted(tried: list[Tried], ends: tuple[float, float]) -> bool:
    """Whether `judged` could accept a minimum within one step of the least I: none of the neighbours it will have is below `RISE`.

    Between the ends of the search, its neighbours have been tried: one that is missing is stretched, and nothing can be accepted.
    """
    least = least_of(tried)
    values = [each.found.inconsistency for each in tried]
    steps = np.log([each.focal / least.focal for each in tried]) / np.log(FOCAL_STEP)
    bracketed = bool(steps.min() <= -0.9 and steps.max() >= 0.9) or not ends[0] <= least.focal <= ends[1]
    apart = [value for value, step in zip(values, steps, strict=True) if abs(step) >= 1.9]
    return bracketed and max(values) - min(values) >= RISE and min(apart, default=RISE) >= RISE


def least_of(tried: list[Tried]) -> Tried:
    """Return the focal length with the least I."""
    return min(tried, key=lambda each: each.found.inconsistency)


def _beside(search: FocalSearch, tried: list[Tried], least: Tried, sides: tuple[int, ...] = (1, -1)) -> list[Tried]:
    """Return the isometries one step on either side of the minimum, unless that side has been tried at this distance or farther."""
    missing = [
        side for side in sides
        if not any(side * np.log(t.focal / least.focal) >= 0.9 * np.log(FOCAL_STEP) for t in tried)
    ]  # fmt: skip
    found = [tried_at(search, least.focal * FOCAL_STEP**side, least) for side in missing]
    return [each for each in found if each is not None]


def _golden(search: FocalSearch, middle: Tried) -> list[Tried]:
    """Return the isometries tried by golden-section search within one step of `middle`, and at the vertex of the final parabola."""
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
        if search.should_stop():
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
        place = least_between(np.log([t.focal for t in three]), np.array([t.found.inconsistency for t in three]))
        if place is not None:
            at(place)
    return made


def least_between(places: Floats, inconsistencies: Floats) -> float | None:
    """Return the minimum of the parabola through I² at three logarithms of focal lengths, at most at their ends; None if it has none."""
    bend, slope, _ = np.polyfit(places - places[1], np.square(inconsistencies), 2)
    return float(np.clip(places[1] - slope / (2 * bend), places[0], places[2])) if bend > 0 else None


def tried_at(search: FocalSearch, focal: float, near: Tried | None) -> Tried | None:
    """Return the isometry at a focal length, started from the depths at `near`.

    If these lead to a surface that is stretched along the viewing rays, it starts again from `search.deepest`. None if this one is
    stretched, too. Without `near`, the search starts here, and a stretched surface is returned.
    """
    graph = search.solved(focal)
    beside = None if near is None else refocused(near.found.depths, graph.seen, focal / near.focal)
    for depths in (beside, search.start(focal)):
        if depths is not None:
            found = refine_with_restarts(graph, depths, should_stop=search.should_stop)
            if near is None or not _stretched(graph, found):
                return Tried(focal, graph, found)
    return None


def _stretched(graph: SurfaceGraph, found: Isometry) -> bool:
    """Return whether some points are too near the camera, or all frames are stretched along the viewing rays more than a plane can be."""
    nearest, farthest = np.where(graph.seen, found.depths, np.inf).min(axis=1), found.depths.max(axis=1)
    frame, edge = graph.pairs
    first, second = graph.edges[edge].T
    points = found.depths[..., None] * graph.rays
    apart = points[frame, first] - points[frame, second]
    ray = graph.rays[frame, first] + graph.rays[frame, second]
    depth = np.square((apart * ray).sum(axis=1)) / np.square(ray).sum(axis=1)
    in_depth, whole = (np.bincount(frame, each) for each in (depth, np.square(apart).sum(axis=1)))
    flat = (in_depth <= MAX_DEPTH_SHARE * whole)[whole > 0]
    return bool((farthest > MAX_DEPTH_RATIO * nearest).any() or (len(flat) > 0 and not flat.any()))


def refocused(depths: Floats, seen: NDArray[np.bool_], ratio: float) -> Floats:
    """Return depths for a focal length `ratio` times as long: the same relief at `ratio` times the distance."""
    mean = depths.sum(axis=1, keepdims=True) / np.maximum(seen.sum(axis=1, keepdims=True), 1)
    return np.where(seen, np.maximum(ratio * mean + (depths - mean), 0.05 * ratio * mean), 0.0)


@dataclass(frozen=True, slots=True)
class Judgement:
    """The evidence for isometry in the focal lengths tried."""

    ratio: float
    """I at the neighbouring focal lengths divided by its minimum; 0 if the minimum is no evidence."""

    clear: bool
    """Whether the minimum is evidence by itself."""

    words: str
    """A sentence if it is evidence, else a clause why it is not."""


def judged(tried: list[Tried], least: Tried) -> Judgement:
    """Return whether I is small and smaller than at the neighbouring focal lengths."""
    value = least.found.inconsistency
    sides = [
        min((t.found.inconsistency for t in tried if (t.focal - least.focal) * side > 0
             and abs(np.log(t.focal / least.focal)) >= 0.9 * np.log(FOCAL_STEP)), default=0.0)
        for side in (-1, 1)
    ]  # fmt: skip
    ratio = min(sides) / value if value > 0 else np.inf
    if value > MAX_INCONSISTENCY:
        return Judgement(0.0, False, f"its edge lengths change by {value:.1%} or more, whatever the focal length")
    if not (ratio >= HINT and _single(tried, least)):
        return Judgement(0.0, False, "its edge lengths do not single out a focal length")
    words = (
        f"Taken as an isometric sheet: at a focal length of {least.focal:.0f} px edge lengths change by {value:.2%}, "
        f"{ratio:.3g} times as much at neighbouring focal lengths."
    )
    return Judgement(ratio, ratio >= CLEAR and min(sides) - value >= RISE, words)


def _single(tried: list[Tried], least: Tried) -> bool:
    """Return whether I rises on both sides of its minimum, within the tolerance `DIP`."""
    for side in (-1, 1):
        away = sorted((t for t in tried if (t.focal - least.focal) * side > 0), key=lambda each: side * each.focal)
        values = np.array([each.found.inconsistency for each in away])
        if bool((values < DIP * np.maximum.accumulate(values)).any()):
            return False
    return True

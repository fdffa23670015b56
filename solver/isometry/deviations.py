"""Standard deviations of the positions of an isometric surface, by a parametric bootstrap.

No truth is known, but the reconstruction is a surface of about the same kind seen in about the same poses. The bootstrap takes it as the
truth: its images, with noise, are refined again, starting from the truth, and the differences are errors of the method on such a surface
(Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, section 6.5). Starting from the conic program, as for the tracks, gives
about the same differences in eight times the time. Every shape is seen in the pose of another frame; in its own pose it would have the
images of the tracks, and the same errors again. The noise follows from the inconsistency I of the edge lengths. It differs from that of the
tracks where edges hide it, or where the surface stretches a little, so differences are scaled to the I of the tracks.

What recorded sheets have beyond the model is not in the bootstrap: they stretch, lenses distort, the principal point is not the centre of
the picture. `MODEL_STD` and `FOCAL_MODEL_STD` are added for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.evaluation.trust import size_of
from pliant.solver.isometry.arc_lengths import arc_chord_ratios, refine_along_surface
from pliant.solver.isometry.focal_sweep import least_between, refocused
from pliant.solver.isometry.inextensible import SurfaceGraph
from pliant.solver.isometry.refinement import Isometry, refine
from pliant.solver.isometry.splines import spline
from pliant.solver.model.so3 import nearest, rotations_of
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats

EXCHANGES = 3
"""Number of reconstructions, each with other poses. Their squared differences are averaged."""

MODEL_STD = 0.01
"""Standard deviation of the positions of sheets that is not in the bootstrap, relative to the size. Chosen with recorded paper and a comic
page, whose errors of .018 and .035 are 4.8 and 3.9 times those of the bootstrap, and made-up paper at d = 4, where they are .9 to 1.6
times. With it, they are 1.5, 2.1 and .3 to .5 times the expected error."""

FOCAL_MODEL_STD = 0.02
"""The same for the focal length, relative to it. Chosen with the same sheets, whose focal lengths are off by .1 to 2.1 %; bootstrap .1 to
.5 %."""

FOCAL_SIDE = 1.1
"""Ratio of the focal lengths next to the true one at which the bootstrap evaluates I: golden-section search narrows the bracket as far."""


@dataclass(frozen=True, slots=True, eq=False)
class Deviations:
    """Standard deviations of the results of a sheet."""

    points: Floats
    """Of the anchors' positions, the same in all frames, shape `(A,)`, the depths' unit."""

    focal: float
    """Of an estimated focal length, relative to it."""


def standard_deviations(
    graph: SurfaceGraph,
    found: Isometry,
    points: Floats,
    frames: NDArray[np.intp],
    *,
    seed: int,
    should_stop: ShouldStop = never,
) -> Deviations | None:
    """Return the standard deviations of positions and focal length; None if stopped before one reconstruction was complete.

    Positions are those for a known focal length, whose error adds little to theirs.

    Parameters
    ----------
    graph : SurfaceGraph
        Rays and edges of all frames.
    found : Isometry
        Their depths and edge lengths.
    points : array, shape (F, A, 3)
        Anchors in camera axes, without gaps.
    frames : array of int, shape (S,)
        Frames that are reconstructed again.
    seed : int
        Of the noise.
    should_stop : callable, optional
        Called between steps; once it returns True, the reconstructions completed so far count.
    """
    frames = np.sort(frames)
    part, shapes = graph.of(frames), points[frames]
    random, squares, off = np.random.default_rng(seed), list[Floats](), list[float]()
    noise = noise_of(found, shapes)
    for exchange in range(EXCHANGES):
        truth = exchanged(shapes, (exchange + 1) * len(frames) // (EXCHANGES + 1))
        seen = replace(part, rays=noisy_rays(truth, part.confidence, noise, random))
        again = refine(seen, np.where(part.seen, truth[..., 2], 0.0), should_stop=should_stop)
        again = refine_along_surface(seen, again, should_stop=should_stop)
        share = found.inconsistency / again.inconsistency if again.inconsistency > 0 else 1.0
        offset = focal_offset(seen, again, should_stop=should_stop)
        if should_stop():
            break
        squares.append(share**2 * _mean_squares(again.depths[..., None] * seen.rays, truth, part.seen))
        off.append(share * offset)
    if not squares:
        return None
    return Deviations(
        np.sqrt(np.mean(squares, axis=0) + (MODEL_STD * size_of(shapes)) ** 2),
        float(np.hypot(np.sqrt(np.square(off).mean()), FOCAL_MODEL_STD)),
    )


def focal_offset(graph: SurfaceGraph, found: Isometry, *, should_stop: ShouldStop = never) -> float:
    """Return the logarithm of the focal length with the least I, relative to that of the rays; within `FOCAL_SIDE`."""
    graph = replace(graph, arc_ratios=arc_chord_ratios(graph, found))
    values = []
    for ratio in (1 / FOCAL_SIDE, 1.0, FOCAL_SIDE):
        other = replace(graph, rays=graph.rays / [ratio, ratio, 1.0])
        depths = refocused(found.depths, graph.seen, ratio)
        values.append(refine(other, depths, should_stop=should_stop).inconsistency)
    places = np.log([1 / FOCAL_SIDE, 1.0, FOCAL_SIDE])
    place = least_between(places, np.array(values))
    return float(places[np.argmin(values)]) if place is None else place


def deviations_at(
    places: Floats, placed: NDArray[np.bool_], deviations: Floats, *, template: Floats, size: float
) -> Floats:
    """Return the standard deviations of all points, shape `(P,)`, from those of the anchors.

    Parameters
    ----------
    places : array, shape (P, 2)
        Template positions.
    placed : array of bool, shape (P,)
        Points that have one. The others are put in the middle of the surface, so that their standard deviation is its size.
    deviations : array, shape (A,)
        Of the anchors.
    template : array, shape (A, 2)
        Template positions of the anchors.
    size : float
        Size of the surface, which no standard deviation exceeds.
    """
    logarithms = spline(template, np.log(deviations)[:, None], places)[:, 0]
    return np.asarray(np.where(placed, np.exp(np.minimum(logarithms, np.log(size))), size))


def noise_of(found: Isometry, points: Floats) -> float:
    """Return the standard deviation of the rays at which lengths of edges parallel to the picture would have the inconsistency I.

    The length of such an edge differs by √2 times the noise of its ends, whose mean absolute value is √(2/π) times its standard deviation.
    """
    length = float(found.lengths[found.lengths > 0].mean())
    return found.inconsistency * length / float(points[..., 2].mean()) * float(np.sqrt(np.pi)) / 2


def exchanged(points: Floats, shift: int) -> Floats:
    """Return shapes `(F, A, 3)` in camera axes in the poses of the frames that are `shift` places earlier, cyclically.

    Frames that would reach behind the camera keep their own pose.
    """
    centre = points.mean(axis=1, keepdims=True)
    centred = points - centre
    rotations = rotations_of(centred)
    moved = (centred @ rotations) @ np.roll(rotations, shift, axis=0).transpose(0, 2, 1) + np.roll(
        centre, shift, axis=0
    )
    before = (moved[..., 2] > 0).all(axis=1)
    return np.where(before[:, None, None], moved, points)


def noisy_rays(points: Floats, confidence: Floats, noise: float, random: np.random.Generator) -> Floats:
    """Return rays through `points (F, A, 3)` with Gaussian noise, whose variance is divided by `confidence (F, A)`, shape `(F, A, 3)`."""
    rays = points / points[..., 2:]
    spread = noise / np.sqrt(np.where(confidence > 0, confidence, 1.0))
    rays[..., :2] += spread[..., None] * random.normal(size=(*confidence.shape, 2))
    return np.asarray(rays)


def _mean_squares(points: Floats, truth: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Return the mean over frames of the squared distances from `truth` of the anchors' visible positions, shape `(A,)`.

    Each frame is aligned by a rigid motion, all of them by one scale. The mean of all anchors replaces that of one that is never visible.
    """
    used = seen[..., None].astype(np.float64)
    here, there = (used * (each - _centroid(each, used)) for each in (points, truth))
    here = here @ nearest(there.transpose(0, 2, 1) @ here).transpose(0, 2, 1)
    scale = float((here * there).sum() / np.square(here).sum())
    squares = np.square(scale * here - there).sum(axis=2)
    count = seen.sum(axis=0)
    return np.asarray(np.where(count > 0, squares.sum(axis=0) / np.maximum(count, 1), squares.sum() / seen.sum()))


def _centroid(points: Floats, used: Floats) -> Floats:
    return np.asarray((used * points).sum(axis=1, keepdims=True) / np.maximum(used.sum(axis=1, keepdims=True), 1))

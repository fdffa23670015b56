"""How far the shapes depend on which points cameras and prior were learned from: a jackknife over parts of the object.

The posterior of `shapes.uncertainty` takes cameras and prior covariance as known. Both are estimated from the same tracks: where points
are few, frames many, or the motion is ambiguous, other points would have led to other shapes. The jackknife measures this. Each of K
compact parts of the object is left out in turn, covariance and cameras are refined from the other points, and the shapes of all points
are computed again.
With x₍ₖ₎ the shapes without part k, x those refined from all points, and x̄ the mean of the x₍ₖ₎,

    variance = (K − 1)/K Σₖ (x₍ₖ₎ − x̄)²,    bias = (K − 1) (x̄ − x),

after a rotation per frame, which `e3d_frame` leaves free. Parts are compact because neighbouring points move alike: with scattered points
left out, their neighbours would stand for them (Künsch 1989, "The jackknife and the bootstrap for general stationary observations").
The sum of posterior variance, variance and squared bias is the corrected variance of empirical Bayes (Laird and Louis 1987, "Empirical
Bayes confidence intervals based on bootstrap samples").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import centred, columns, depth_map
from pliant.solver.evaluation.alignment import procrustes
from pliant.solver.model.expectation_maximisation import improve
from pliant.solver.model.marginal_likelihood import fit
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.records import Floats
from pliant.solver.refinement.learned import Learned, motion_of, moved_to, scene_at
from pliant.solver.tracks.frame_selection import between, evenly_spread
from scipy.spatial import cKDTree

PARTS = 6
"""K. More parts cost more; with 3 parts the dance has .063 instead of .115 (true .102)."""

MAX_JACKKNIFE_FRAMES = 100
"""Maximum number of frames, evenly spread; the others are interpolated."""

LEARNING_ROUNDS, TURNING_ITERATIONS = 20, 60
"""Rounds of expectation maximisation and L-BFGS iterations of a refinement. One that ends before the minimum understates the change: with 5
and 15 the dance has .070."""

MIN_LEARNED_POINTS = 4
"""Minimum number of points to learn from."""

CLUSTERING = 5
"""Rounds of k-means for the parts."""


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """How far positions change by what cameras and prior were learned from, at some points of the object."""

    std: Floats | None
    """Root mean squared change of the points, shape `(F, S)`, normalized units; None: 0 everywhere."""

    points: Floats
    """Their mean positions, shape `(S, 3)`, world axes, normalized units."""

    bounded: bool = True
    """False: nothing is known about depth, so every position is as uncertain as the object is large."""

    def std_of(self, shapes: Floats, unit: float, *, centred: bool = True) -> Floats:
        """Return that of every position, shape `(F, P)`; each point takes the value of the nearest one.

        Parameters
        ----------
        shapes : ndarray, shape (F, P, 3)
            World axes.
        unit : float
            One normalized unit, the unit of the shapes and of the result.
        centred : bool
            False: the object's centre is the origin, and not the mean of these points.
        """
        middle = shapes.mean(axis=1) if centred else np.zeros((len(shapes), 3))
        if not self.bounded:
            return np.asarray(np.linalg.norm(shapes - middle[:, None], axis=2))
        if self.std is None:
            return np.zeros(shapes.shape[:2])
        mean = (shapes.mean(axis=0) - middle.mean(axis=0)) / unit
        return np.asarray((unit * self.std)[:, cKDTree(self.points).query(mean)[1]])


def learning_changes(
    estimate: CameraEstimate,
    covariance: ShapeCovariance,
    *,
    turning: bool,
    should_stop: Callable[[], bool] | None = None,
) -> Changes:
    """Return how far positions change by what cameras and prior were learned from.

    Parameters
    ----------
    estimate : CameraEstimate
        With the sample of the (corrected) tracks.
    covariance : ShapeCovariance
        Of all F frames, in the axes of the estimate.
    turning : bool
        False keeps the cameras.
    should_stop : callable, optional
        Called between refinements; once it returns True, the changes are 0.
    """
    frames, nothing = len(estimate.rotations), Changes(None, np.zeros((0, 3)))
    used = evenly_spread(frames, MAX_JACKKNIFE_FRAMES)
    start = Learned(
        np.asarray(estimate.rotations)[used],
        np.asarray(estimate.scales)[used],
        replace(covariance, modes=covariance.modes[used]),
        np.inf,
    )
    sample = centred(np.asarray(estimate.sample)[used])
    if sample.shape[1] <= MIN_LEARNED_POINTS:
        return nothing
    part_of = parts(sample)
    without = []
    try:
        everything = _shapes_from(sample, np.ones(len(part_of), dtype=bool), start, turning)
        for part in np.unique(part_of):
            if should_stop is not None and should_stop():
                return nothing
            if (part_of != part).sum() >= MIN_LEARNED_POINTS:
                without.append(_onto(_shapes_from(sample, part_of != part, start, turning), everything))
    except np.linalg.LinAlgError:  # depth without bounds
        return replace(nothing, bounded=False)
    if len(without) < 2:
        return nothing
    squared = between(used, _mean_squared_change(np.stack(without), everything), frames)
    squared /= np.square(np.asarray(estimate.scales))[:, None]
    world = np.einsum("fij,fpi->pj", start.rotations / start.scales[:, None, None], everything) / len(used)
    return Changes(np.sqrt(squared), world)


def parts(sample: Floats) -> NDArray[np.intp]:
    """Return the compact part of the object that every point of `sample (F, S, 2)` belongs to: k-means of paths, started far apart."""
    paths = sample.transpose(1, 0, 2).reshape(sample.shape[1], -1)
    first = int(np.square(paths - paths.mean(axis=0)).sum(axis=1).argmax())
    middles, nearest = [paths[first]], np.square(paths - paths[first]).sum(axis=1)
    while len(middles) < min(PARTS, len(paths)):
        middles.append(paths[int(nearest.argmax())])
        nearest = np.minimum(nearest, np.square(paths - middles[-1]).sum(axis=1))
    centres = np.stack(middles)
    for _ in range(CLUSTERING):
        part_of = cKDTree(centres).query(paths)[1]
        centres = np.stack(
            [paths[part_of == k].mean(axis=0) if (part_of == k).any() else c for k, c in enumerate(centres)]
        )
    return np.asarray(part_of, dtype=np.intp)


def _mean_squared_change(without: Floats, everything: Floats) -> Floats:
    """Return variance plus squared bias, shape `(F, S)`, of shapes `(K, F, S, 3)` against those from all points."""
    count = len(without)
    mean = without.mean(axis=0)
    variance = (count - 1) / count * np.square(without - mean).sum(axis=(0, 3))
    bias = (count - 1) * (mean - centred(everything))
    return np.asarray(variance + np.square(bias).sum(axis=2))


def _shapes_from(sample: Floats, kept: NDArray[np.bool_], start: Learned, turning: bool) -> Floats:
    """Return posterior mean shapes `(F, S, 3)` in camera axes under cameras and covariance refined from some of the points."""
    rows = columns(sample[:, kept])
    gram = rows @ rows.T / rows.shape[1]
    projections = start.rotations[:, :2] * start.scales[:, None, None]
    covariance = improve(start.covariance, gram, projections, iterations=LEARNING_ROUNDS)
    found = replace(start, covariance=covariance)
    if turning:
        scene = scene_at(gram, start.rotations, with_scales=bool((start.scales != 1).any()), ordered=covariance.ordered)
        moved = fit(scene, motion_of(scene, found), iterations=TURNING_ITERATIONS, turning=True)
        found = moved_to(scene, found, *moved)
    depths = depth_map(found.rotations, found.scales, found.covariance) @ columns(sample)
    return np.concatenate([sample, depths[..., None]], axis=2)


def _onto(shapes: Floats, others: Floats) -> Floats:
    """Return the shapes, each frame centred and rotated onto the other's."""
    moved, fixed = centred(shapes), centred(others)
    turns = procrustes(fixed.transpose(0, 2, 1) @ moved, proper=True)
    return np.asarray(moved @ turns.transpose(0, 2, 1))

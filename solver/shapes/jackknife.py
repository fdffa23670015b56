"""Uncertainty from learning: a jackknife over parts of the object, since other points would give other cameras and priors.

The posterior of `shapes.uncertainty` takes cameras and prior covariance as known. Both are estimated from the same tracks: with few points,
many frames or ambiguous motion, other points would have led to other shapes. The jackknife measures this. It leaves out each of K compact
parts of the object in turn, refines covariance and cameras from the observations of the other points, and recomputes the shapes of all
points. Hidden entries are expected values under the covariance of the solve, as in `refinement.observed`. Where early stopping limits the
covariance (`model.early_stopping`), it is learned from scratch in the same rounds, before and after the cameras are refined.
With x₍ₖ₎ the shapes without part k, x the shapes refined from all points, and x̄ the mean of the x₍ₖ₎,

    variance = (K − 1)/K Σₖ (x₍ₖ₎ − x̄)²,    bias = (K − 1) (x̄ − x),

after aligning each frame by a rotation, as the error measure `e3d_frame` does. Parts are compact because neighbouring points move alike:
the neighbours of scattered points would replace them (Künsch 1989, "The jackknife and the bootstrap for general stationary observations").
The sum of posterior variance, variance and squared bias is the corrected variance of empirical Bayes (Laird and Louis 1987, "Empirical
Bayes confidence intervals based on bootstrap samples").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import depth_map
from pliant.solver.model.early_stopping import Schedule, schedule
from pliant.solver.model.expectation_maximisation import ModelOrder, improve
from pliant.solver.model.marginal_likelihood import fit
from pliant.solver.model.observation_model import ImageDensity
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import nearest
from pliant.solver.pulse import ShouldStop
from pliant.solver.records import MIN_POINTS, Floats
from pliant.solver.refinement.learned import Learned, motion_of, moved_to, scene_at
from pliant.solver.shapes.uncertainty import distant_paths
from pliant.solver.tracks.frame_selection import between, evenly_spread
from pliant.solver.tracks.matrix import centred, columns, gram_of, points_of
from scipy.spatial import cKDTree

PARTS = 6
"""K. More parts cost more. Estimated error of the dance sequence with 3, 6 and 8 parts: .125, .136 and .150; true error .096."""

MAX_JACKKNIFE_FRAMES = 100
"""Maximum number of frames evaluated, evenly spread; the others are interpolated."""

LEARNING_ROUNDS, TURNING_ITERATIONS = 20, 60
"""Iterations of expectation maximisation and of L-BFGS in each refinement. Ending before the minimum understates the change: with 5 and 15,
the estimated error of the dance sequence is .128, with 40 and 120 it is .169."""

CLUSTERING = 5
"""Iterations of k-means for the parts."""


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """Standard deviation of positions due to the choice of points from which cameras and prior are learned, at sampled points."""

    std: Floats | None
    """Root mean squared change of the sampled points, shape `(F, S)`, normalized units; None means 0 everywhere."""

    points: Floats
    """Mean positions of the sampled points, shape `(S, 3)`, world axes, normalized units."""

    bounded: bool = True
    """False if depth is unbounded: every position then has its distance from the centre as standard deviation."""

    def std_of(self, shapes: Floats, unit: float, *, centred: bool = True) -> Floats:
        """Return the standard deviation of every position, shape `(F, P)`; each point takes the value of the nearest sampled one.

        Parameters
        ----------
        shapes : ndarray, shape (F, P, 3)
            World axes.
        unit : float
            One normalized unit in the unit of the shapes and the result.
        centred : bool
            Whether the object's centre is the mean of these points; otherwise it is the origin.
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
    observed: NDArray[np.bool_],
    *,
    turning: bool,
    seed: int = 0,
    should_stop: ShouldStop,
) -> Changes:
    """Return how far positions change with the points from which cameras and prior are learned.

    Parameters
    ----------
    estimate : CameraEstimate
        Contains a sample of the (corrected) tracks.
    covariance : ShapeCovariance
        Prior of all F frames, in the axes of the estimate.
    observed : array of bool, shape (F, S)
        Which entries of the sample are observations; the others, hidden or rejected, do not count.
    turning : bool
        Whether to refine the cameras too.
    seed : int
        Seed of the folds of early stopping.
    should_stop : callable
        Called between refinements; once it returns True, the changes are 0.
    """
    frames, nothing = len(estimate.rotations), Changes(None, np.zeros((0, 3)))
    used = evenly_spread(frames, MAX_JACKKNIFE_FRAMES)
    start = Learned(
        estimate.rotations[used],
        estimate.scales[used],
        replace(covariance, modes=covariance.modes[used]),
        np.inf,
    )
    sample = _Sample(centred(estimate.sample[used]), observed[used])
    if sample.points.shape[1] <= MIN_POINTS:
        return nothing
    every, without = np.ones(sample.points.shape[1], dtype=bool), []
    try:
        points = points_of(sample.expected(start, every)[0])
        order = ModelOrder(ordered=covariance.ordered)
        early = schedule(points, start.projections, order, seed=seed, should_stop=should_stop)
        part_of, everything = parts(points), _shapes_from(sample, every, start, early, turning)
        for part in np.unique(part_of):
            if should_stop():
                return nothing
            if (part_of != part).sum() >= MIN_POINTS:
                without.append(_onto(_shapes_from(sample, part_of != part, start, early, turning), everything))
    except np.linalg.LinAlgError:  # depth is unbounded
        return replace(nothing, bounded=False)
    if len(without) < 2:
        return nothing
    squared = between(used, _mean_squared_change(np.stack(without), everything), frames)
    squared /= np.square(estimate.scales)[:, None]
    world = np.einsum("fij,fpi->pj", start.rotations / start.scales[:, None, None], everything) / len(used)
    return Changes(np.sqrt(squared), world)


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """Tracks of the sampled points in the frames used."""

    points: Floats
    """Centred, shape `(F', S, 2)`, normalized units."""

    observed: NDArray[np.bool_]
    """Shape `(F', S)`."""

    def expected(self, found: Learned, kept: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Return expected tracks `(2F', n)` of the n points kept, and the expectation of W Wᵀ / n, shape `(2F', 2F')`."""
        points, observed = self.points[:, kept], self.observed[:, kept]
        if observed.all():
            rows = columns(points)
            return rows, gram_of(rows)
        image = found.covariance.of_image(found.projections)
        density = ImageDensity.of(image, found.covariance.noise_variance)
        means, covariance = density.moments(np.where(observed[..., None], points, 0.0), observed.astype(np.float64))
        return means, (means @ means.T + covariance) / means.shape[1]


def parts(sample: Floats) -> NDArray[np.intp]:
    """Return the index of the compact part of each point of `sample (F, S, 2)`: k-means of paths, starting from distant ones."""
    paths = sample.transpose(1, 0, 2).reshape(sample.shape[1], -1)
    first = int(np.square(paths - paths.mean(axis=0)).sum(axis=1).argmax())
    centres = paths[distant_paths(paths, first, PARTS)[0]]
    for _ in range(CLUSTERING):
        part_of = cKDTree(centres).query(paths)[1]
        centres = np.stack(
            [paths[part_of == k].mean(axis=0) if (part_of == k).any() else c for k, c in enumerate(centres)]
        )
    return np.asarray(part_of, dtype=np.intp)


def _mean_squared_change(without: Floats, everything: Floats) -> Floats:
    """Return variance plus squared bias, shape `(F, S)`, of shapes `(K, F, S, 3)` relative to the shapes from all points."""
    count = len(without)
    mean = without.mean(axis=0)
    variance = (count - 1) / count * np.square(without - mean).sum(axis=(0, 3))
    bias = (count - 1) * (mean - centred(everything))
    return np.asarray(variance + np.square(bias).sum(axis=2))


def _shapes_from(
    sample: _Sample, kept: NDArray[np.bool_], start: Learned, early: Schedule | None, turning: bool
) -> Floats:
    """Return posterior mean shapes `(F', S, 3)` in camera axes, with cameras and covariance refined from the points kept."""
    gram = sample.expected(start, kept)[1]

    def relearned(found: Learned) -> Learned:
        projections = found.projections
        if early is None:
            return replace(found, covariance=improve(found.covariance, gram, projections, iterations=LEARNING_ROUNDS))
        return replace(found, covariance=early.learned(gram, projections))

    found = relearned(start)
    if turning:
        with_scales = bool((start.scales != 1).any())
        scene = scene_at(gram, start.rotations, with_scales=with_scales, ordered=found.covariance.ordered)
        moved = fit(scene, motion_of(scene, found), iterations=TURNING_ITERATIONS, turning=True)
        found = moved_to(scene, found, *moved)
        if early is not None:
            found = relearned(found)
    means, _ = sample.expected(found, np.ones(kept.shape, dtype=bool))
    depths = depth_map(found.rotations, found.scales, found.covariance) @ means
    return np.concatenate([points_of(means), depths[..., None]], axis=2)


def _onto(shapes: Floats, others: Floats) -> Floats:
    """Return the shapes with each frame centred and rotated onto the same frame of `others`."""
    moved, fixed = centred(shapes), centred(others)
    turns = nearest(fixed.transpose(0, 2, 1) @ moved)
    return np.asarray(moved @ turns.transpose(0, 2, 1))

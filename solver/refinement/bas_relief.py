"""Extent of depth where the cameras hardly rotate: one step along the bas-relief family, with a prior on the depth.

A deep object that rotates little and a flat one that rotates more look alike (the bas-relief ambiguity; Belhumeur, Kriegman and Yuille
1999). Let d be the mean optical axis in world axes. Multiplying depth along d by λ and dividing rotations off d by λ changes the images
only to second order in the angles. For angles of a few degrees the likelihood hardly depends on λ, and the camera-motion prior, which
rewards less variance of the motion down to a small floor (`model.camera_motion_prior`), favours too little rotation and too much depth.
Refinement is slow along this curved valley; here λ alone is changed, to minimise

    E(λ) + weight · (3/2 log((2 + x) / 3) − 1/2 log x),    x = a λ² / (b r²).

E is the negative log likelihood without the camera-motion prior, a the variance of the positions along d, b the mean of those across.
The penalty is the negative log density of log x for x with an F distribution of 1 and 2 degrees of freedom, the ratio of a variance along
one axis to one along two. It is dimensionless and grows as 2 log λ and log 1/λ. If the object rotates by tens of degrees, E dominates and
λ is 1 to within a fraction of a percent.

Perspective does not resolve the ambiguity unless the focal length φ is known: images of depths λz with focal length λφ have the same
z/φ, so tracks corrected for perspective are those of an orthographic camera, and E(λ) is that of these tracks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.model.marginal_likelihood import CAMERA_PRIOR_WEIGHT, energy
from pliant.solver.model.so3 import exponential
from pliant.solver.records import Floats
from pliant.solver.refinement.learned import Learned, motion_of, scene_at
from pliant.solver.tracks.matrix import columns
from scipy.optimize import minimize_scalar
from scipy.special import polygamma

VISIBLE_DEPTH = (1 / 2 - 4 / 9) ** 0.5 / 0.5
"""r, standard deviation of depth over that of x or y: .47 for the half of a sphere that faces the camera, with points evenly spread over
the picture (the means of z², z and x² are 1/2, 2/3 and 1/4)."""

MAX_STRETCH = 30.0
"""Bound on λ and 1/λ."""

DECIDED = 1.25
"""λ or 1/λ below which the depth counts as determined by the tracks."""

LOG_DEPTH_STD = float(polygamma(1, 0.5) + polygamma(1, 1.0)) ** 0.5 / 2
"""Standard deviation of ½ log x under the prior, 1.28: a typical depth may be wrong by a factor of 3 or 4."""

MAX_ANGLE = np.radians(60.0)
"""Angle from d, rad, that no frame may exceed after the step: bas-relief is an approximation for small angles."""


def at_probable_depth(gram: Floats, found: Learned) -> tuple[Learned, float]:
    """Return cameras and covariance at the most probable λ, and λ.

    Parameters
    ----------
    gram : array, shape (2F, 2F)
        W Wᵀ / P of the tracks from which `found` was estimated.
    found : Learned
        Scaled-orthographic cameras, and covariance.
    """
    toward, rolls, tilts = _decomposed(found.rotations)
    largest = float(np.linalg.norm(tilts, axis=1).max())
    least = np.log(max(1 / MAX_STRETCH, largest / MAX_ANGLE))
    if least >= 0:
        return found, 1.0
    spread = _spread(found)
    depth = float(toward @ spread @ toward)
    expected = VISIBLE_DEPTH**2 * (float(np.trace(spread)) - depth) / 2

    def cost(log_stretch: float) -> float:
        moved = _stretched(found, float(np.exp(log_stretch)), toward, rolls, tilts)
        scene = replace(
            scene_at(gram, moved.rotations, with_scales=True, ordered=moved.covariance.ordered), prior_weight=0.0
        )
        return energy(scene, motion_of(scene, moved))[0] + CAMERA_PRIOR_WEIGHT * extent_penalty(
            depth / expected * float(np.exp(2 * log_stretch))
        )

    # A grid search first: the likelihood is flat far from its minimum.
    grid = np.linspace(least, np.log(MAX_STRETCH), 25)
    costs = [cost(float(each)) for each in grid]
    best = int(np.argmin(costs))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    step = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-4})
    at = min((0.0, float(grid[best]), float(step.x)), key=cost)
    moved = _stretched(found, float(np.exp(at)), toward, rolls, tilts)
    scene = scene_at(gram, moved.rotations, with_scales=True, ordered=moved.covariance.ordered)
    return replace(moved, energy=energy(scene, motion_of(scene, moved))[0]), float(np.exp(at))


def is_typical(stretch: float) -> bool:
    """Whether the prior determines the depth: λ or 1/λ is at least `DECIDED`."""
    return bool(abs(np.log(stretch)) >= np.log(DECIDED))


def bulges(found: Learned, sample: Floats, *, y_up: bool) -> bool:
    """Whether the rigid shape bulges towards the camera: its middle is nearer than its rim, as for the visible half of a sphere.

    Orthography does not distinguish a shape from its mirror image in depth; surfaces seen from the front mostly bulge.

    Parameters
    ----------
    found : Learned
        Scaled-orthographic cameras, and covariance.
    sample : array, shape (F, S, 2)
        Centred tracks of sampled points.
    y_up : bool
        Whether y points up in the images, and z therefore toward the camera.
    """
    frames = len(sample)
    rows = found.projections.reshape(2 * frames, 3)
    rigid = np.linalg.pinv(rows) @ columns(sample)
    toward = _decomposed(found.rotations)[0]
    depth = (toward @ rigid) * (-1 if y_up else 1)
    width = rigid - np.outer(toward, toward @ rigid)
    radius = (width**2).sum(axis=0)
    return bool(depth @ (radius - radius.mean()) >= 0)


def extent_penalty(ratio: float) -> float:
    """Return the negative log density of log x at x = `ratio` > 0, shifted to a minimum of 0."""
    return 1.5 * float(np.log((2 + ratio) / 3)) - 0.5 * float(np.log(ratio))


def _decomposed(rotations: Floats) -> tuple[Floats, Floats, Floats]:
    """Return d (3,), rolls (F, 3, 3) about the optical axis, and the tilts applied before them, rotation vectors (F, 3) orthogonal to d."""
    axes = rotations[:, 2]
    mean = axes.sum(axis=0)
    toward = mean / max(float(np.linalg.norm(mean)), np.finfo(float).tiny)
    cross = np.cross(axes, toward)
    sine = np.linalg.norm(cross, axis=1)
    angles = np.arctan2(sine, axes @ toward)
    tilts = cross * (angles / np.maximum(sine, np.finfo(float).tiny))[:, None]
    return toward, rotations @ exponential(-tilts), tilts


def _stretched(found: Learned, stretch: float, toward: Floats, rolls: Floats, tilts: Floats) -> Learned:
    """Return cameras and covariance with depth along d multiplied and tilts divided by λ."""
    along = np.eye(3) + (stretch - 1) * np.outer(toward, toward)
    covariance = found.covariance.turned(along)
    size = float(np.trace(covariance.axis_covariance)) / 3
    changed = replace(
        covariance,
        axis_covariance=covariance.axis_covariance / size,
        modes=covariance.modes * size**0.5,
        walk_variance=covariance.walk_variance * size,
    )
    return replace(found, rotations=rolls @ exponential(tilts / stretch), covariance=changed)


def _spread(found: Learned) -> Floats:
    """Return the covariance of the positions over points, averaged over frames, shape `(3, 3)`."""
    covariance = found.covariance
    moving = float((covariance.modes**2).sum()) / len(covariance.modes) + covariance.walk_variance
    return np.asarray(covariance.mean_covariance + moving * covariance.axis_covariance)

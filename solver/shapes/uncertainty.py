"""Posterior standard deviations of positions under the Gaussian shape prior.

With cameras Π, noise variance σ²/w for an observation of confidence w, and the prior covariance Σ of a point's path
(`model.shape_covariance`), the posterior covariance of the path is

    Σ − Σ Πᵀ (Π Σ Πᵀ + σ² W⁻¹)⁻¹ Π Σ,

restricted to the observations of the point (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006,
equation 2.24). Under orthography it depends only on the point's visibility pattern. Under perspective with κ = 1/φ the
image v = w / (1 + κz), relative to the principal point, has the derivative

    ∂v/∂x = (s_f R_f[:2] − κ v ⊗ s_f R_f[2]) / (1 + κz),

which replaces Π and differs from point to point; it is evaluated at one representative of each compact part of the object. The variances
of points that are visible in all frames, or in none, which have the prior's, are exact, and so are those of a sample of the others. For the
remaining points, the ratio of the variance of a position to that of a point visible in all frames is the mean of the ratios of the sampled
points with the most similar visibility. Cameras are taken as known, so the standard deviations are lower bounds where few frames or little
motion leave the cameras uncertain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.model.resection import MIN_RELATIVE_DISTANCE
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.pulse import pulse
from pliant.solver.records import Camera, Floats
from pliant.solver.shapes.sparsely_observed import WELL_OBSERVED_SHARE
from pliant.solver.tracks.frame_selection import between, evenly_spread
from scipy import linalg
from scipy.spatial import cKDTree

MAX_POSTERIOR_FRAMES = 300
"""Maximum number of frames evaluated, evenly spread, because the cost is cubic in frames. Fewer observations only increase
the standard deviations."""

MAX_OPERATIONS = 2e10
"""Maximum number of floating-point operations for visibility patterns: a few seconds on one core."""

MAX_PATTERNS = 1000
"""Maximum number of patterns evaluated; most sequences have fewer points, and all of them are exact."""

SIMILAR_PATTERNS = 3
"""Number of evaluated patterns from which the variances of another point are predicted. With 46 of 754 points evaluated, the RMS
difference of the logarithm from the exact standard deviation is .19 where an object hides itself (.20 with one pattern), and .37 where
tracks begin and end anywhere (.50)."""

PATTERNS_AT_ONCE = 4096
"""Points compared with the evaluated patterns at once; bounds the memory at 4 million distances."""

REPRESENTATIVES = 24
"""Number of points at which the derivative of a perspective image is evaluated. On a face 3 half-sizes away, the median standard deviation
differs from the one with a derivative for every point by 3 %; by 5 % with 8 representatives, and by 23 % with orthography."""


@dataclass(frozen=True, slots=True, eq=False)
class Pinhole:
    """Quantities needed for the derivative of a perspective image."""

    views: Floats
    """v, images relative to the principal point, shape `(F, P, 2)`, in the unit of the covariance."""

    depth_rows: Floats
    """∂z/∂x = ± s_f R_f[2], shape `(F, 3)`."""

    depths: Floats
    """z, shape `(F, P)`, in the unit of the covariance."""

    inverse_focal: float
    """κ = 1/φ, in the inverse unit of the covariance; positive."""

    @classmethod
    def of(cls, camera: Camera, shapes: Floats, unit: float) -> Pinhole | None:
        """Build from shapes `(F, P, 3)` in the tracks' unit and the size `unit` of a normalized unit; None for orthographic cameras."""
        if camera.focal is None:
            return None
        away = (-1.0 if camera.y_up else 1.0) * camera.scales[:, None] * camera.rotations[:, 2]
        views = (camera.project(shapes) - camera.principal_point) / unit
        return cls(views, away, camera.depths(shapes) / unit, unit / camera.focal)

    def derivatives(self, projections: Floats, point: int) -> Floats:
        """Return ∂v/∂x of a point in every frame, shape `(F, 2, 3)`."""
        bent = projections - self.inverse_focal * self.views[:, point, :, None] * self.depth_rows[:, None]
        nearer = np.maximum(1 + self.inverse_focal * self.depths[:, point], MIN_RELATIVE_DISTANCE)
        return np.asarray(bent / nearer[:, None, None])


def position_std(
    covariance: ShapeCovariance,
    projections: Floats,
    confidence: Floats,
    *,
    noise_std: float,
    pinhole: Pinhole | None = None,
    seed: int = 0,
) -> Floats:
    """Return the posterior standard deviation of every position: the root of the expected squared distance to the truth.

    Parameters
    ----------
    covariance : ShapeCovariance
        The prior of all F frames.
    projections : ndarray, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    confidence : ndarray, shape (F, P)
        Weights of the observations in [0, 1]; 0 means hidden or rejected.
    noise_std : float
        Standard deviation of an image coordinate, in the unit of the covariance.
    pinhole : Pinhole, optional
        Perspective cameras; None for orthographic ones.
    seed : int
        Seed of the random sample of patterns.

    Returns
    -------
    ndarray, shape (F, P)
        In the unit of the covariance.
    """
    frames = len(projections)
    used = evenly_spread(frames, MAX_POSTERIOR_FRAMES)
    noise, weights = noise_std**2, confidence[used]
    chosen, nearest = _representatives(pinhole, used, confidence.shape[1])
    moments = [_moments(covariance, _rows(projections, pinhole, point), used) for point in chosen]
    complete = np.stack([_variance(*each, np.ones(len(used)), noise) for each in moments], axis=1)
    found, shown = complete[:, nearest], (weights > 0).any(axis=0)
    found[:, ~shown] = moments[0][0][:, None]
    partly = np.flatnonzero(shown & (weights != 1).any(axis=0))
    if len(partly):
        sample = _sample(weights[:, partly], seed)
        exact = [_variance(*moments[int(nearest[point])], weights[:, point], noise) for point in partly[sample]]
        found[:, partly] = _predicted(found[:, partly], weights[:, partly], sample, np.stack(exact, axis=1))
    if len(used) < frames:
        found = between(used, found, frames)
    return np.asarray(np.sqrt(np.maximum(found, 0.0)))


def _rows(projections: Floats, pinhole: Pinhole | None, point: int) -> Floats:
    return projections if pinhole is None else pinhole.derivatives(projections, point)


def _representatives(
    pinhole: Pinhole | None, used: NDArray[np.intp], count: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the representatives' point indices, and which of them supplies the derivative of each point.

    Under orthography all points have the same derivative. Otherwise representatives have distant image paths.
    """
    if pinhole is None:
        return np.zeros(1, dtype=np.intp), np.zeros(count, dtype=np.intp)
    paths = pinhole.views[used].transpose(1, 0, 2).reshape(count, -1)
    return distant_paths(paths, int(np.square(paths - paths.mean(axis=0)).sum(axis=1).argmin()), REPRESENTATIVES)


def distant_paths(paths: Floats, first: int, limit: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Choose at most `limit` distant points by farthest-point sampling (Gonzalez 1985), given paths `(P, d)` and the first index.

    Returns the indices of the points chosen, and the number of the nearest of them for every point.
    """
    chosen, nearest = [first], np.zeros(len(paths), dtype=np.intp)
    distance = np.square(paths - paths[first]).sum(axis=1)
    while len(chosen) < min(limit, len(paths)):
        chosen.append(int(distance.argmax()))
        to_new = np.square(paths - paths[chosen[-1]]).sum(axis=1)
        nearest = np.where(to_new < distance, len(chosen) - 1, nearest)
        distance = np.minimum(distance, to_new)
    return np.array(chosen), nearest


def bounded_by_neighbours(std: Floats, shapes: Floats, visible: Floats) -> Floats:
    """Bound the standard deviations of sparsely observed points by those of their neighbours, in place, and return them.

    These points are placed on the surface (`shapes.sparsely_observed`), which the prior of a single path does not model. The
    nearest well-observed point usually lies on the same surface, so its distance bounds the error of the position.

    Parameters
    ----------
    std : array, shape (F, P)
        Standard deviations, the unit of the shapes.
    shapes : array, shape (F, P, 3)
        Positions of the points.
    visible : array, shape (F, P)
        Confidence, 0 where hidden.
    """
    often = np.flatnonzero((visible > 0).mean(axis=0) >= WELL_OBSERVED_SHARE)
    rarely = np.setdiff1d(np.arange(shapes.shape[1]), often)
    if len(often) == 0 or len(rarely) == 0:
        return std
    mean = shapes.mean(axis=0)
    nearest = often[cKDTree(mean[often]).query(mean[rarely])[1]]
    away = np.linalg.norm(shapes[:, rarely] - shapes[:, nearest], axis=2)
    std[:, rarely] = np.minimum(std[:, rarely], np.hypot(std[:, nearest], away))
    return std


def _moments(covariance: ShapeCovariance, projections: Floats, used: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Return tr Σ_ff `(F,)`, Σ Πᵀ `(3F, 2F)` and Π Σ Πᵀ `(2F, 2F)` for the frames used."""
    rows, over_frames = projections[used].reshape(-1, 3), covariance.over_frames_at(used)
    mean, path = rows @ covariance.mean_covariance, rows @ covariance.axis_covariance
    wide = np.repeat(over_frames, 2, axis=1)
    crossed = (mean.T[None, :, :] + path.T[None, :, :] * wide[:, None, :]).reshape(3 * len(used), -1)
    prior = np.trace(covariance.mean_covariance) + np.diag(over_frames) * np.trace(covariance.axis_covariance)
    return np.asarray(prior), crossed, covariance.of_exact_image(projections[used], used)


def _variance(prior: Floats, crossed: Floats, image: Floats, weights: Floats, noise: float) -> Floats:
    """Return the trace of the posterior covariance of each frame's position, shape `(F,)`, for one visibility pattern."""
    pulse()
    seen = np.flatnonzero(np.repeat(weights > 0, 2))
    if len(seen) == 0:
        return prior
    inner = image[np.ix_(seen, seen)]
    rounding = np.finfo(float).eps * float(np.trace(inner))  # less noise would leave the matrix singular
    inner[np.diag_indices(len(seen))] += np.maximum(noise / np.repeat(weights, 2)[seen], rounding)
    factor = linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)
    explained = linalg.solve_triangular(factor, crossed[:, seen].T, lower=True, check_finite=False)
    return np.asarray(prior - np.einsum("rc,rc->c", explained, explained).reshape(-1, 3).sum(axis=1))


def _sample(weights: Floats, seed: int) -> NDArray[np.intp]:
    """Return the points whose patterns are evaluated exactly."""
    frames, points = weights.shape
    count = int(np.clip(MAX_OPERATIONS / (16 * frames**3), 8, MAX_PATTERNS))
    if points <= count:
        return np.arange(points)
    return np.sort(np.random.default_rng(seed).choice(points, count, replace=False))


def _predicted(everything: Floats, weights: Floats, sample: NDArray[np.intp], exact: Floats) -> Floats:
    """Return variances `(F, P)`: exact ones for the sample, elsewhere `everything` times the ratios of similar patterns.

    The mean of the logarithms is weighted by the inverse squared distance between patterns (Shepard 1968): an equal pattern has all weight.
    Fewer observations never lower a variance, so a ratio below 1 is rounding.
    """
    rounding, known = np.finfo(float), weights[:, sample]
    least = np.maximum(everything[:, sample], np.maximum(rounding.eps * exact, rounding.tiny))
    ratio = np.log(np.maximum(exact / least, 1.0))
    found, squares, count = everything.copy(), np.square(known).sum(axis=0), min(SIMILAR_PATTERNS, len(sample))
    others = np.setdiff1d(np.arange(weights.shape[1]), sample)
    for start in range(0, len(others), PATTERNS_AT_ONCE):
        some = others[start : start + PATTERNS_AT_ONCE]
        pulse()
        own = weights[:, some]
        distance = np.square(own).sum(axis=0)[:, None] + squares - 2 * own.T @ known
        similar = np.argpartition(distance, count - 1, axis=1)[:, :count]
        nearness = 1 / np.maximum(np.take_along_axis(distance, similar, axis=1), 1e-9 * len(known))
        nearness /= nearness.sum(axis=1, keepdims=True)
        found[:, some] *= np.exp(np.einsum("fpk,pk->fp", ratio[:, similar], nearness))
    found[:, sample] = exact
    return found

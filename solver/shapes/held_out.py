"""Cross-validation: the error with which cameras and prior predict held-out images of a point from its other images.

Given cameras Π and prior covariance Σ, the images w ∈ R^{2N} of a point in the N frames that show it are N(0, V), V = Π Σ Πᵀ + σ² W⁻¹.
Predicting a block B of them from all others has the error

    e_B = [V⁻¹]_BB⁻¹ [V⁻¹ w]_B,    with covariance [V⁻¹]_BB⁻¹,

the same as a solve without B, but without repeating the solve for each block (Rasmussen and Williams, Gaussian Processes for Machine
Learning, 2006, equations 5.10 to 5.12, here for blocks). A block is a tenth of the frames, consecutive, because a single frame of a film
is easily interpolated from its neighbours even if the model is wrong. Residuals of the solve cannot replace this test: a model with as many
modes as frames fits even white noise to 4 % of its size, and predicts none of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.solver.energy.hyperparameters import noise_std
from pliant.solver.evaluation.trust import size_of
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.records import Camera, Floats, Tracks, projections_of
from pliant.solver.shapes.sparsely_observed import WELL_OBSERVED_SHARE
from pliant.solver.tracks.completion import ranks
from pliant.solver.tracks.frame_selection import evenly_spread
from pliant.solver.tracks.noise import weighted_median
from scipy import linalg

MAX_HELD_OUT_FRAMES, MAX_HELD_OUT_POINTS = 100, 40
"""Maximum numbers of frames, evenly spread, and of points, spread by their distance from the centroid. The cost is cubic in frames: about
5 ms for each visibility pattern."""

FOLDS = 10
"""Number of blocks of frames that are held out in turn; sequences of fewer frames hold out single frames."""

LEAST_CONFIDENCE = 1e-3
"""Confidence below which an observation counts as hidden."""


def held_out_errors(covariance: Floats, images: Floats, blocks: list[NDArray[np.intp]]) -> Floats:
    """Return observed minus predicted images, each predicted without the images of its block; 0 outside all blocks.

    Parameters
    ----------
    covariance : ndarray, shape (2N, 2N)
        V, with the two coordinates of an image adjacent.
    images : ndarray, shape (K, N, 2)
        Images of K points with the same V.
    blocks : list of ndarray
        Image indices of each block.

    Raises
    ------
    numpy.linalg.LinAlgError
        V is not positive definite.
    """
    factor = linalg.cho_factor(covariance, lower=True, check_finite=False)
    inverse = linalg.cho_solve(factor, np.eye(len(covariance)), check_finite=False)
    weighted = inverse @ images.reshape(len(images), -1).T
    errors = np.zeros_like(weighted)
    for block in blocks:
        rows = (2 * block[:, None] + [0, 1]).reshape(-1)
        errors[rows] = np.linalg.solve(inverse[np.ix_(rows, rows)], weighted[rows])
    return np.asarray(errors.T.reshape(images.shape))


def held_out_error(
    tracks: Tracks,
    shapes: Floats,
    camera: Camera,
    confidence: Floats,
    covariance: ShapeCovariance,
    *,
    unit: float,
) -> float | None:
    """Return the median distance of held-out observations from their predictions, relative to the size of the shapes.

    Parameters
    ----------
    tracks : Tracks
        F frames of P points.
    shapes : ndarray, shape (F, P, 3)
        In the tracks' unit. Used to correct the tracks for perspective and to normalize the result.
    camera : Camera
        Cameras of the solution.
    confidence : ndarray, shape (F, P)
        Confidence of the observations used; 0 where hidden or rejected.
    covariance : ShapeCovariance
        The prior of all F frames, in normalized units.
    unit : float
        The tracks' unit per normalized unit.

    Returns
    -------
    float or None
        None if no point is observed in at least three frames and a quarter of those used, or if rounding makes V indefinite.
    """
    frames = len(shapes)
    used = evenly_spread(frames, MAX_HELD_OUT_FRAMES)
    chosen = _spread(shapes[frames // 2], (confidence[used] >= LEAST_CONFIDENCE).sum(axis=0), len(used))
    weights = confidence[np.ix_(used, chosen)]
    weights = np.where(weights < LEAST_CONFIDENCE, 0.0, weights)
    images = _corrected(tracks.points[:, chosen], shapes[:, chosen], camera)[used] / unit
    try:
        image = covariance.of_exact_image(projections_of(camera.rotations, camera.scales)[used], used)
        errors = _errors(image, noise_std(covariance) ** 2, images, weights)
    except np.linalg.LinAlgError:
        return None
    seen = weights > 0
    distances = np.where(seen, np.linalg.norm(errors, axis=2), 0.0) / camera.scales[used, None]
    if not seen.any():
        return None
    return unit * weighted_median(distances[seen], weights[seen]) / size_of(shapes)


def _errors(image: Floats, noise: float, images: Floats, weights: Floats) -> Floats:
    """Return the errors of held-out images `(F', K, 2)`; points with the same confidences share V."""
    errors = np.zeros_like(images)
    patterns, pattern_of = np.unique(weights, axis=1, return_inverse=True)
    for index, pattern in enumerate(patterns.T):
        seen, points = np.flatnonzero(pattern), np.flatnonzero(pattern_of.reshape(-1) == index)
        rows = (2 * seen[:, None] + [0, 1]).reshape(-1)
        own = image[np.ix_(rows, rows)]
        own[np.diag_indices(len(rows))] += noise / np.repeat(pattern[seen], 2)
        found = held_out_errors(own, images[np.ix_(seen, points)].transpose(1, 0, 2), _blocks(seen, len(weights)))
        errors[np.ix_(seen, points)] = found.transpose(1, 0, 2)
    return errors


def _spread(shape: Floats, counts: NDArray[np.intp], frames: int) -> NDArray[np.intp]:
    """Return well-observed points (in at least three frames), spread by their distance from the centroid of a shape `(P, 3)`."""
    often = np.flatnonzero(counts >= max(3, WELL_OBSERVED_SHARE * frames))
    ordered = often[np.argsort(ranks(shape[None, often] - shape.mean(axis=0)))]
    return np.asarray(ordered[evenly_spread(len(often), MAX_HELD_OUT_POINTS)])


def _corrected(points: Floats, shapes: Floats, camera: Camera) -> Floats:
    """Return tracks `(F, K, 2)` without translation, corrected to what an orthographic camera would observe."""
    flat = camera.scales[:, None, None] * (shapes @ camera.rotations[:, :2].transpose(0, 2, 1))
    off = points - camera.project(shapes)
    if camera.focal is not None:
        off *= (1 + camera.depths(shapes) / camera.focal)[..., None]
    return np.asarray(flat + off)


def _blocks(seen: NDArray[np.intp], frames: int) -> list[NDArray[np.intp]]:
    """Return the indices into `seen` of the images in each tenth of the frames, omitting a block that contains all images."""
    fold = seen * min(FOLDS, frames) // frames
    blocks = [np.flatnonzero(fold == each) for each in np.unique(fold)]
    return [block for block in blocks if len(block) < len(seen)]

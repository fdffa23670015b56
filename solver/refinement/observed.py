"""Cameras and shape covariance from the observations themselves: hidden entries and outliers by expectation.

The completion of `tracks.completion` ignores cameras and shapes, treats its predictions as observations, and follows some outliers.
`cross_fitted` finds these outliers with a covariance learned from other points. `on_observations` completes the camera estimation: it
alternates between expected moments of the complete tracks (`model.observation_model`) and cameras, which is expectation maximisation with
L-BFGS on the marginal likelihood as its M-step.

Under perspective, κ is estimated once more as well. Completion is orthographic, both where it predicts hidden entries and where it moves
entries of low confidence towards its prediction, so a focal length learned from completed tracks is too long. Expected tracks have the
perspective of the latest κ instead. Where only a prior determines the depth, it is estimated again after every refinement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import Perspective, corrected, depth_map
from pliant.solver.model.expectation_maximisation import ModelOrder, learned
from pliant.solver.model.observation_model import ImageDensity, inlier_probabilities
from pliant.solver.model.resection import MIN_RELATIVE_DISTANCE
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, projections_of
from pliant.solver.refinement.bas_relief import at_probable_depth
from pliant.solver.refinement.depth_alternation import alternate
from pliant.solver.refinement.learned import START_EM_ROUNDS, Learned, Refinement
from pliant.solver.tracks.completion import briefly_hidden, often_visible
from pliant.solver.tracks.matrix import columns, gram_of, points_of
from pliant.solver.tracks.normalization import Normalized

ROUNDS = 3
"""Updates of expected moments and cameras, and of κ under perspective. With 5, focal lengths are closer and errors about the same: of four
tracked films of a face 1.10, 1.10, 1.07 and 1.14 times the true one instead of 1.19, 1.10, 1.07 and 1.14; without perspective, other
numbers were not tried."""

FOLDS = 2
"""Folds of the points, each scored by a covariance learned from the others; other numbers were not tried."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Observations of the sampled points in the frames used."""

    points: Floats
    """Shape `(F', S, 2)`, normalized units, about the centroids of the visible points."""

    confidence: Floats
    """v, shape `(F', S)`, at most 1; 0 where hidden."""

    weight: Floats
    """v, but 0 for entries that completion replaced as outliers, shape `(F', S)`."""

    chosen: NDArray[np.intp]
    """Indices of the sampled points, shape `(S,)`."""

    often: NDArray[np.bool_]
    """Mask of the often visible points, shape `(S,)`: their mean is the origin of the depths."""

    briefly: NDArray[np.bool_]
    """Mask of the points from which κ is learned, shape `(S,)`."""

    view: Perspective | None
    """Perspective at the frames used; None where tracks are not corrected."""

    depth_is_typical: bool
    """As in `CameraEstimate`."""

    @classmethod
    def of(cls, normalized: Normalized, estimate: CameraEstimate, used: NDArray[np.intp]) -> Observed:
        """Return the observations of the points that completion sampled."""
        assert estimate.filling is not None
        chosen = estimate.sampled
        points, confidence = normalized.points[:, chosen], normalized.visible[:, chosen]
        weight = np.where(estimate.filling.outliers(points, confidence), 0.0, confidence)
        view = estimate.perspective
        view = replace(view, offsets=view.offsets[used]) if view is not None and view.is_perspective else None
        often, briefly = (mask(normalized.visible)[chosen] for mask in (often_visible, briefly_hidden))
        return cls(
            points[used], confidence[used], weight[used], chosen, often, briefly, view, estimate.depth_is_typical
        )


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Expected complete tracks of the sampled points, divided by the starting scales."""

    gram: Floats
    """Expectation of W Wᵀ / S about the centroids, shape `(2F', 2F')`."""

    sample: Floats
    """Expected tracks about the centroids, shape `(F', S, 2)`."""

    translations: Floats
    """Centroids, normalized units, shape `(F', 2)`."""

    outlier_share: float
    """α, the share of outliers."""


def cross_fitted(
    observed: Observed,
    estimate: CameraEstimate,
    used: NDArray[np.intp],
    *,
    seed: int,
    should_stop: ShouldStop = never,
) -> tuple[Floats, float]:
    """Return the probability that each observation is an inlier, shape `(F', S)`, and the share of outliers.

    Each point is scored by a covariance learned from others: modes learned from a point with outliers follow these.

    Parameters
    ----------
    observed : Observed
        Observations in the same frames.
    estimate : CameraEstimate
        First cameras, and completed tracks that are not yet corrected for perspective.
    used : array of int, shape (F',)
        Indices of the frames used.
    seed : int
        Seed of the folds.
    should_stop : callable, optional
        Called between rounds of EM.
    """
    projections = projections_of(estimate.rotations[used], estimate.scales[used])
    points = observed.points - estimate.translations[used, None]
    points = np.where(observed.confidence[..., None] > 0, points, 0.0)
    part = np.random.default_rng(seed).permutation(points.shape[1]) % FOLDS
    found, shares = np.zeros(observed.confidence.shape), []
    for fold in range(FOLDS):
        others, own = estimate.sample[used][:, part != fold], part == fold
        rows = columns(others)
        covariance = learned(
            gram_of(rows),
            projections,
            ModelOrder(ordered=estimate.ordered),
            iterations=START_EM_ROUNDS,
            should_stop=should_stop,
        )
        image, weight, share = covariance.of_image(projections), observed.weight[:, own], estimate.outlier_share
        for _ in range(2):  # the second pass rejects the outliers of the first
            found[:, own], share = inlier_probabilities(
                image, covariance.noise_variance, points[:, own], observed.confidence[:, own], weight, share=share
            )
            weight = observed.confidence[:, own] * found[:, own]
        shares.append(share)
    return found, float(np.mean(shares))


def on_observations(
    observed: Observed,
    found: Learned,
    completed: Moments,
    start_scales: Floats,
    how: Refinement,
) -> tuple[Learned, Moments, Perspective | None]:
    """Return cameras and covariance estimated from the observations, the expected moments, and the perspective with its κ.

    Parameters
    ----------
    observed : Observed
        Observations in the frames used.
    found : Learned
        Starting cameras and covariance.
    completed : Moments
        Moments of the completed tracks.
    start_scales : array, shape (F',)
        Starting scales, to which the cameras are relative.
    how : Refinement
        What is refined.
    """
    if how.should_stop():
        return found, completed, observed.view
    moments = _expected(observed, found, completed, start_scales)
    for _ in range(ROUNDS):
        if how.should_stop():
            break
        if observed.view is not None:
            found, observed = _with_updated_focal(observed, found, moments, start_scales, how)
            moments = _expected(observed, found, moments, start_scales)
        found = how.refine_once(moments.gram, found)
        if observed.depth_is_typical:
            found, observed = _with_typical_depth(observed, found, moments)
        moments = _expected(observed, found, moments, start_scales)
    return found, moments, observed.view


def _with_updated_focal(
    observed: Observed, found: Learned, moments: Moments, start_scales: Floats, how: Refinement
) -> tuple[Learned, Observed]:
    """Return cameras and covariance after one round of alternation on the expected tracks, and the observations with its κ."""
    assert observed.view is not None
    view = replace(observed.view, learning_sample=_as_seen(observed, found, moments, start_scales)[:, observed.briefly])
    absolute = replace(found, scales=found.scales * start_scales)
    absolute, view = alternate(view, absolute, np.arange(len(start_scales)), how, rounds=1)
    return replace(absolute, scales=absolute.scales / start_scales), replace(observed, view=view)


def _with_typical_depth(observed: Observed, found: Learned, moments: Moments) -> tuple[Learned, Observed]:
    """Return cameras and covariance at the most probable depth, and the observations with the κ that belongs to it.

    Refinement prefers too little rotation, with the observations as with completed tracks. Corrected tracks stay the same.
    """
    moved, stretch = at_probable_depth(moments.gram, found)
    view = observed.view
    if view is None:
        return moved, observed
    std = None if view.inverse_focal_std is None else view.inverse_focal_std / stretch
    view = replace(view, inverse_focal=view.inverse_focal / stretch, inverse_focal_std=std)
    return moved, replace(observed, view=view)


def _as_seen(observed: Observed, found: Learned, moments: Moments, start_scales: Floats) -> Floats:
    """Return the expected tracks with the perspective of the latest κ, relative to the principal point, shape `(F', S, 2)`."""
    assert observed.view is not None
    view, depths = observed.view, _depths(observed, found, moments, start_scales)
    complete = moments.sample * start_scales[:, None, None] + (moments.translations + view.offsets)[:, None]
    return np.asarray(complete / np.maximum(1 + view.inverse_focal * depths, MIN_RELATIVE_DISTANCE)[..., None])


def _expected(observed: Observed, found: Learned, before: Moments, start_scales: Floats) -> Moments:
    """Return the moments under these cameras and this covariance; the tracks are corrected with the depths of `before`."""
    points = _corrected(observed, found, before, start_scales) - before.translations[:, None]
    points = np.where(observed.confidence[..., None] > 0, points / start_scales[:, None, None], 0.0)
    projections = found.projections
    image, noise = found.covariance.of_image(projections), found.covariance.noise_variance
    probability, share = inlier_probabilities(
        image, noise, points, observed.confidence, observed.weight, share=before.outlier_share
    )
    means, covariance = ImageDensity.of(image, noise).moments(points, observed.confidence * probability)
    middle = means.mean(axis=1)
    means -= middle[:, None]
    frames, count = points.shape[:2]
    moved = middle.reshape(frames, 2) * start_scales[:, None]
    return Moments(
        (means @ means.T + covariance) / count, points_of(means),
        before.translations + moved, share,
    )  # fmt: skip


def _corrected(observed: Observed, found: Learned, before: Moments, start_scales: Floats) -> Floats:
    """Return the observations corrected for perspective, about the centroids of the visible points, `(F', S, 2)`."""
    view = observed.view
    if view is None:
        return observed.points
    depths = _depths(observed, found, before, start_scales)
    return corrected(observed.points + view.offsets[:, None], depths, view.inverse_focal) - view.offsets[:, None]


def _depths(observed: Observed, found: Learned, moments: Moments, start_scales: Floats) -> Floats:
    """Return the depths of the expected tracks relative to the mean of the often visible points, shape `(F', S)`."""
    depth = depth_map(found.rotations, found.scales * start_scales, found.covariance)
    depths = depth @ columns(moments.sample * start_scales[:, None, None])
    return np.asarray(depths - depths[:, observed.often].mean(axis=1, keepdims=True))

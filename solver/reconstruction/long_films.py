"""Long films: learn from a subset of the frames, add the others by resection, and refine all cameras together.

Cameras and covariance are learned from evenly spread frames. Resection then gives every frame, independently of its neighbours, the camera
and deformation with which the points' mean shapes explain it best (`model.resection`). Finally the cameras of all frames are refined
together by the marginal likelihood. Both steps are linear in the number of frames: the likelihood uses the tracks of a sample of points as
a factor of their Gram matrix, which is never formed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import Perspective, corrected, depth_map
from pliant.solver.model.expectation_maximisation import ModelOrder
from pliant.solver.model.resection import MeanShapes, Poses, Views, interpolated, predicted, resected
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import angles_between, start_at_identity
from pliant.solver.monitor import enter
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.reconstruction.observations import Observations
from pliant.solver.records import Floats, mean_scale, projections_of, read_only
from pliant.solver.refinement.covariance_learning import LearningData
from pliant.solver.refinement.learned import Learned, Refinement
from pliant.solver.tracks.completion import Filling, gross
from pliant.solver.tracks.matrix import centred, columns

PREDICTED_TOGETHER = 256
"""Maximum number of frames predicted at once, to bound the memory."""


def extended(
    estimate: CameraEstimate,
    covariance: ShapeCovariance,
    used: NDArray[np.intp],
    observations: Observations,
    *,
    should_stop: ShouldStop = never,
) -> tuple[CameraEstimate, LearningData]:
    """Return cameras and covariance of all frames of a film.

    Parameters
    ----------
    estimate
        Cameras of the frames used.
    covariance
        Prior of the frames used, in the same axes.
    used : array of int, shape (F',)
        Indices of the frames used, increasing.
    observations : Observations
        Tracks of all F frames.
    should_stop : callable, optional
        Called between units of work; once it returns True, the remaining frames are interpolated.
    """
    enter(should_stop, "extension")
    frames = len(observations.normalized.points)
    turning = observations.turning
    scales, rotations = estimate.scales, estimate.rotations
    with_scales = bool((scales != 1).any()) and observations.known_scales is None
    shapes = MeanShapes.of(covariance, rotations, scales, estimate.sample)
    views = _views(observations, estimate)
    poses = interpolated(used, rotations, scales, covariance.modes, frames)
    if observations.known is not None:
        poses = replace(poses, rotations=np.array(observations.known.rotations))
        if observations.known_scales is not None:
            poses = replace(poses, scales=np.array(observations.known_scales))
    begun = poses.rotations
    poses = resected(views, shapes, poses, turning=turning, with_scales=with_scales, should_stop=should_stop)
    if turning:
        sample = _completed(views, shapes, poses)
        start = Learned(poses.rotations, poses.scales, replace(covariance, modes=poses.coefficients), np.inf)
        how = Refinement(with_scales=with_scales, should_stop=should_stop)
        moved = how.refine_once(np.zeros((0, 0)), start, factor=columns(sample) / sample.shape[1] ** 0.5)
        poses = replace(poses, rotations=moved.rotations, scales=moved.scales * mean_scale(poses.scales))
        poses = resected(views, shapes, poses, turning=False, with_scales=False, should_stop=should_stop)
    return _whole(estimate, covariance, observations, views, shapes, poses, begun)


def _views(observations: Observations, estimate: CameraEstimate) -> Views:
    """Return the tracks of the sampled points, relative to the principal point if perspective is corrected."""
    normalized, view = observations.normalized, estimate.perspective
    points = normalized.points[:, estimate.sampled].transpose(0, 2, 1)
    weight = normalized.visible[:, estimate.sampled]
    if view is None or not view.is_perspective or observations.lens is None:
        return Views(np.ascontiguousarray(points), weight)
    return Views(points + observations.lens.offsets[:, :, None], weight, view.inverse_focal)


def _completed(views: Views, shapes: MeanShapes, poses: Poses) -> Floats:
    """Return the sampled tracks with hidden positions and outliers predicted, corrected for perspective and centred, `(F, S, 2)`."""
    return centred(_filled(views, shapes, poses, as_seen=False))


def _filled(views: Views, shapes: MeanShapes, poses: Poses, *, as_seen: bool) -> Floats:
    """Return the sampled tracks with hidden positions and outliers predicted, corrected for perspective unless `as_seen`."""
    done = []
    std = shapes.variance**0.5
    for low in range(0, len(views.points), PREDICTED_TOGETHER):
        part = slice(low, low + PREDICTED_TOGETHER)
        _, image, nearer = predicted(shapes, poses.part(part), views.inverse_focal)
        seen, guess = (each.transpose(0, 2, 1) for each in (views.points[part], image))
        if views.inverse_focal and as_seen:
            guess = guess / nearer[..., None]
        elif views.inverse_focal:
            seen = corrected(seen, (nearer - 1) / views.inverse_focal, views.inverse_focal)
        trust = np.where(gross(seen, views.weight[part], guess, std), 0.0, views.weight[part])[..., None]
        done.append(np.where(trust == 1, seen, guess + trust * (seen - guess)))
    return np.concatenate(done)


def _whole(
    estimate: CameraEstimate,
    covariance: ShapeCovariance,
    observations: Observations,
    views: Views,
    shapes: MeanShapes,
    poses: Poses,
    begun: Floats,
) -> tuple[CameraEstimate, LearningData]:
    """Return the estimate of all frames, with an estimated first rotation set to the identity, and its covariance as learning data."""
    size = mean_scale(poses.scales) if observations.known_scales is None else 1.0
    scales = poses.scales / size
    first = poses.rotations[0] if observations.known is None else np.eye(3)
    rotations = start_at_identity(poses.rotations) if observations.known is None else poses.rotations
    whole = _of_all_frames(covariance, poses.coefficients, first, size)
    sample = _completed(views, shapes, poses)
    clean = estimate.filling is None and bool((observations.normalized.visible == 1).all())
    moved = poses.translations
    if views.inverse_focal and observations.lens is not None:
        moved = moved - observations.lens.offsets
    turn = float(np.degrees(angles_between(poses.rotations, begun).mean()))
    reasons = dict(estimate.reasons)
    if observations.turning:
        reasons["rotations"] = (
            f"{reasons.get('rotations', '')} These are {len(estimate.rotations)} of {len(rotations)} frames; the others follow by "
            f"resection, {turn:.2f}° on average from the interpolated rotations, and all are refined together."
        ).strip()
    for array in (rotations, scales):
        read_only(array)
    filling = None if clean else _filling(whole, rotations, scales, poses, shapes)
    estimate = replace(
        estimate, rotations=rotations, scales=scales, translations=np.zeros_like(moved) if clean and not views.inverse_focal else moved,
        sample=sample, reasons=reasons, hypotheses=(), candidates=(), filling=filling,
        perspective=_perspective(estimate, observations, views, shapes, poses, whole, rotations, scales, filling),
    )  # fmt: skip
    data = LearningData(
        np.zeros((0, 0)), sample, projections_of(rotations, scales), np.arange(len(rotations)),
        ModelOrder(ordered=covariance.ordered), covariance=whole,
        rotations=rotations, scales=scales, turned=False,
    )  # fmt: skip
    return estimate, data


def _of_all_frames(covariance: ShapeCovariance, coefficients: Floats, axes: Floats, size: float) -> ShapeCovariance:
    """Return the covariance with the coefficients of all frames, in axes given by the rows of `axes`, scaled by `size`."""
    return replace(
        covariance,
        mean_covariance=size**2 * axes @ covariance.mean_covariance @ axes.T,
        axis_covariance=axes @ covariance.axis_covariance @ axes.T,
        modes=size * coefficients,
        walk_variance=size**2 * covariance.walk_variance,
    )


def _filling(
    covariance: ShapeCovariance, rotations: Floats, scales: Floats, poses: Poses, shapes: MeanShapes
) -> Filling:
    """Return the low-rank factor that predicts hidden entries of any point: the images of the covariance's columns."""
    images = covariance.image_model(projections_of(rotations, scales)).columns.reshape(len(rotations), 2, -1)
    basis = np.concatenate([images, poses.translations[:, :, None]], axis=2)
    return Filling(basis, np.eye(images.shape[2]), shapes.variance**0.5)


def _perspective(
    estimate: CameraEstimate,
    observations: Observations,
    views: Views,
    shapes: MeanShapes,
    poses: Poses,
    covariance: ShapeCovariance,
    rotations: Floats,
    scales: Floats,
    filling: Filling | None,
) -> Perspective | None:
    view, lens = estimate.perspective, observations.lens
    if view is None or lens is None:
        return view
    view = replace(view, offsets=lens.offsets, filling=filling)
    if not view.is_perspective:
        return replace(view, learning_sample=np.zeros((0, 0, 2)))
    seen = _filled(views, shapes, poses, as_seen=True)
    return replace(view, learning_sample=seen, depth=depth_map(rotations, scales, covariance))

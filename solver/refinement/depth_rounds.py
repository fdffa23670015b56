"""Camera estimation under perspective: the cycle tracks → cameras and covariance → depths → corrected tracks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import Perspective, corrected_moments, depth_map, mirrored
from pliant.solver.cameras.planar_ambiguity import is_planar
from pliant.solver.model.model_order import ModelOrder
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import MIRROR
from pliant.solver.records import Floats, read_only
from pliant.solver.refinement.affine_iterations import affine_iterations
from pliant.solver.refinement.bas_relief import LOG_DEPTH_STD
from pliant.solver.refinement.depth_alternation import alternated, factorized_again
from pliant.solver.refinement.focal_length import search
from pliant.solver.refinement.learned import Learned, stretched
from pliant.solver.tracks.completion import briefly_hidden
from pliant.solver.tracks.normalization import Normalized

RESTARTS = 3
"""Maximum number of restarts of the alternation from cameras of the corrected tracks; the evidence converges after one or two."""

MIN_GAIN = 0.01
"""Decrease of the energy, per point and frame, below which no further restart is tried and another start is not preferred: equal solutions
from different starts differ by as much."""


def settled(
    estimate: CameraEstimate,
    normalized: Normalized,
    used: NDArray[np.intp],
    *,
    model_order: ModelOrder,
    turning: bool,
    should_stop: Callable[[], bool] | None = None,
) -> CameraEstimate:
    """Return the estimate with κ determined and the tracks corrected; if κ is 0, only `perspective` is updated.

    Parameters
    ----------
    estimate : CameraEstimate
        Estimate from the uncorrected tracks; `perspective` has the given parameters.
    normalized : Normalized
        The uncorrected tracks.
    used : array of int, shape (F',)
        Frames to learn from.
    model_order : ModelOrder
        Maximum number of modes, and the starting noise.
    turning : bool
        False keeps the rotations, except for the sign of depth.
    should_stop : callable, optional
        Called between fits; once it returns True, the best so far is returned.
    """
    assert estimate.perspective is not None
    whole = estimate.sample + (estimate.perspective.offsets + estimate.translations)[:, None]
    briefly = briefly_hidden(normalized.visible)[estimate.sampled]
    view = replace(estimate.perspective, filling=estimate.filling, sample=whole[:, briefly], whole=whole)
    rotations, scales = np.asarray(estimate.rotations), np.asarray(estimate.scales)
    view, found = search(
        view.sample[used], rotations[used], scales[used], view,
        model_order=model_order, turning=turning, should_stop=should_stop,
    )  # fmt: skip
    if not view.bends:
        return replace(estimate, perspective=view)
    reached, best = _converged(
        estimate, normalized, used, found, view, model_order=model_order, turning=turning, should_stop=should_stop
    )
    if not turning or is_planar(reached.gram):
        return reached
    reached, best = _restarted(reached, normalized, used, best, model_order=model_order, should_stop=should_stop)
    start = affine_iterations(
        view.sample[used], rotations[used], scales[used], view, model_order=model_order, should_stop=should_stop
    )
    if start is None:
        return reached
    found, curvature = start
    other, found = _converged(
        estimate, normalized, used, found, replace(view, curvature=curvature),
        model_order=model_order, turning=True, should_stop=should_stop,
    )  # fmt: skip
    other, found = _restarted(other, normalized, used, found, model_order=model_order, should_stop=should_stop)
    return other if found.energy < best.energy - MIN_GAIN else reached


def _converged(
    estimate: CameraEstimate,
    normalized: Normalized,
    used: NDArray[np.intp],
    found: Learned,
    view: Perspective,
    *,
    model_order: ModelOrder,
    turning: bool,
    should_stop: Callable[[], bool] | None,
) -> tuple[CameraEstimate, Learned]:
    """Return the estimate with the tracks corrected after alternation from `found` and κ, with κ positive where z points away."""
    if view.curvature * view.signs[0] < 0:
        view = replace(view, curvature=-view.curvature, flipped=-1)
        turned, covariance = mirrored(found.rotations, found.covariance)
        found = replace(found, rotations=turned, covariance=covariance)
        estimate = replace(estimate, rotations=MIRROR @ np.asarray(estimate.rotations) @ MIRROR)
    found, view = alternated(view, found, used, model_order=model_order, turning=turning, should_stop=should_stop)
    return _applied(estimate, normalized, used, found, view), found


def _restarted(
    estimate: CameraEstimate,
    normalized: Normalized,
    used: NDArray[np.intp],
    found: Learned,
    *,
    model_order: ModelOrder,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[CameraEstimate, Learned]:
    """Return the estimate after alternations from cameras of the corrected tracks, repeated while the evidence rises.

    `found` holds the estimate's cameras and covariance at the frames used, and is returned refined.
    """
    scales = np.asarray(estimate.scales)
    for _ in range(RESTARTS):
        view = estimate.perspective
        assert view is not None
        rotations = factorized_again(scales, view, found, used, model_order=model_order, should_stop=should_stop)
        if rotations is None:
            break
        start = replace(found, rotations=rotations[used])
        other, moved = alternated(view, start, used, model_order=model_order, turning=True, should_stop=should_stop)
        gain = found.energy - other.energy
        if gain <= 0:
            break
        estimate, found = _applied(replace(estimate, rotations=rotations), normalized, used, other, moved), other
        if gain < MIN_GAIN:
            break
    return estimate, found


def settled_again(
    estimate: CameraEstimate,
    normalized: Normalized,
    used: NDArray[np.intp],
    found: Learned,
    scales: Floats,
    *,
    model_order: ModelOrder,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[CameraEstimate, Learned]:
    """Return the estimate with tracks corrected for the refined cameras and covariance, and these refined once more.

    `found` belongs to tracks divided by `scales`, shape `(F',)`.
    """
    view = estimate.perspective
    assert view is not None
    whole = replace(found, scales=found.scales * scales)
    whole, view = alternated(view, whole, used, model_order=model_order, turning=True, should_stop=should_stop)
    return _applied(estimate, normalized, used, whole, view), replace(whole, scales=whole.scales / scales)


def with_stretched_depth(
    estimate: CameraEstimate,
    normalized: Normalized,
    used: NDArray[np.intp],
    found: Learned,
    scales: Floats,
    stretch: float,
) -> CameraEstimate:
    """Return the estimate with the depths of `found`, λ = `stretch` times the previous ones, and κ/λ, which change the tracks alike.

    `found` belongs to tracks divided by `scales`, shape `(F',)`. The prior on the depth determines κ only as well as the depth.
    """
    view = estimate.perspective
    assert view is not None
    curvature, std = view.curvature / stretch, (view.curvature_std or 0.0) / stretch
    view = replace(view, curvature=curvature, curvature_std=float(np.hypot(std, LOG_DEPTH_STD * curvature)))
    return _applied(estimate, normalized, used, replace(found, scales=found.scales * scales), view)


def with_depth_map(
    estimate: CameraEstimate, covariance: ShapeCovariance, rotations: Floats, scales: Floats
) -> CameraEstimate:
    """Return the estimate with D of this covariance and these cameras, in the same axes, if tracks are corrected."""
    view = estimate.perspective
    if view is None or not view.bends:
        return estimate
    depth = depth_map(rotations, scales, covariance)
    return replace(estimate, perspective=replace(view, depth=depth))


def _applied(
    estimate: CameraEstimate, normalized: Normalized, used: NDArray[np.intp], found: Learned, view: Perspective
) -> CameraEstimate:
    """Return the estimate with the rotations found, and with Gram matrix, sample and translations of the corrected tracks."""
    every = stretched(found, used, np.asarray(estimate.rotations))
    view = replace(view, depth=depth_map(every.rotations, every.scales, every.covariance))
    gram, translations, sample = corrected_moments(view, normalized)
    read_only(every.rotations)
    return replace(
        estimate, rotations=every.rotations, gram=gram, translations=translations, sample=sample, perspective=view
    )  # fmt: skip

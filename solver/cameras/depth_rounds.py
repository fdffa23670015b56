"""Camera estimates under perspective: tracks → cameras and covariance → depths → corrected tracks → again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.focal_length import refined_with_focal, search
from pliant.solver.cameras.learned import Learned
from pliant.solver.cameras.perspective import (
    MIRROR,
    Perspective,
    centred,
    columns,
    corrected,
    corrected_moments,
    depth_map,
    depths_of,
    mirrored,
)
from pliant.solver.model.model_order import ModelOrder
from pliant.solver.model.shape_covariance import ShapeCovariance, annealed
from pliant.solver.model.so3 import exponential, logarithm
from pliant.solver.records import Floats, read_only
from pliant.solver.tracks.normalization import Normalized

ROUNDS = 3
"""Updates of depths, covariance, cameras and κ every time that cameras were found or refined."""

LEARNING = 60
"""Rounds of expectation maximisation of an update."""


def settled(
    estimate: CameraEstimate,
    normalized: Normalized,
    used: NDArray[np.intp],
    *,
    model_order: ModelOrder,
    turning: bool,
    should_stop: Callable[[], bool] | None = None,
) -> CameraEstimate:
    """Return the estimate with κ found and the tracks corrected, or unchanged but for the trace where κ is 0.

    Parameters
    ----------
    estimate : CameraEstimate
        Of the tracks as they are, with `perspective` as far as it is given.
    normalized : Normalized
        The tracks as they are.
    used : array of int, shape (F',)
        Frames to learn from.
    model_order : Support
        Modes at most, and the noise to begin with.
    turning : bool
        False leaves the rotations, but for the sign of depth.
    should_stop : callable, optional
        Asked between fits; once it says True, the best so far is returned.
    """
    assert estimate.perspective is not None
    shift = estimate.perspective.offsets + estimate.translations
    view = replace(
        estimate.perspective, filling=estimate.filling, sample=estimate.sample + shift[:, None]
    )  # fmt: skip
    rotations, scales = np.asarray(estimate.rotations), np.asarray(estimate.scales)
    view, covariance = search(
        view.sample[used], rotations[used], scales[used], view, model_order=model_order, should_stop=should_stop
    )
    if not view.bends:
        return replace(estimate, perspective=view)
    if view.curvature * view.signs[0] < 0:
        view = replace(view, curvature=-view.curvature, flipped=-1)
        covariance = mirrored(rotations, covariance)[1]
        rotations = MIRROR @ rotations @ MIRROR
        estimate = replace(estimate, rotations=rotations)
    found = Learned(rotations[used], scales[used], covariance, np.inf)
    for _ in range(ROUNDS):
        if should_stop is not None and should_stop():
            break
        found = _relearned(view, found, used, model_order)
        found, view = _with_focal(view, found, used, turning=turning)
    return _applied(estimate, normalized, used, found, view)


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
    """Return the estimate with tracks corrected anew, now that cameras and covariance are refined, and both refined once more.

    `found` belongs to tracks divided by `scales`, shape `(F',)`.
    """
    view = estimate.perspective
    assert view is not None
    whole = replace(found, scales=found.scales * scales)
    for _ in range(ROUNDS):
        if should_stop is not None and should_stop():
            break
        whole = _relearned(view, whole, used, model_order)
        whole, view = _with_focal(view, whole, used, turning=True)
    return _applied(estimate, normalized, used, whole, view), replace(whole, scales=whole.scales / scales)


def with_depth_map(estimate: CameraEstimate, covariance: ShapeCovariance) -> CameraEstimate:
    """Return the estimate with the depths of this covariance, where tracks are corrected."""
    view = estimate.perspective
    if view is None or not view.bends:
        return estimate
    depth = depth_map(np.asarray(estimate.rotations), np.asarray(estimate.scales), covariance)
    return replace(estimate, perspective=replace(view, depth=depth))


def _relearned(view: Perspective, found: Learned, used: NDArray[np.intp], model_order: ModelOrder) -> Learned:
    views = view.sample[used]
    depths = depths_of(depth_map(found.rotations, found.scales, found.covariance), views, view.curvature)
    rows = columns(centred(corrected(views, depths, view.curvature)))
    projections = found.rotations[:, :2] * found.scales[:, None, None]
    covariance = annealed(
        rows @ rows.T / rows.shape[1],
        projections,
        max_modes=model_order.max_modes,
        noisy_start=model_order.noisy_start,
        iterations=LEARNING,
    )
    return replace(found, covariance=covariance)


def _with_focal(
    view: Perspective, found: Learned, used: NDArray[np.intp], *, turning: bool
) -> tuple[Learned, Perspective]:
    zooms = bool((found.scales != 1).any())
    found, curvature = refined_with_focal(
        view.sample[used], found, view.curvature, free=view.given is None, turning=turning, with_scales=zooms
    )
    return found, replace(view, curvature=curvature)


def _applied(
    estimate: CameraEstimate, normalized: Normalized, used: NDArray[np.intp], found: Learned, view: Perspective
) -> CameraEstimate:
    """Return the estimate with the cameras found, and with Gram matrix, sample and translations of the corrected tracks."""
    frames = len(normalized.points)
    before = np.asarray(estimate.rotations)
    turns = logarithm(found.rotations @ before[used].transpose(0, 2, 1))
    rotations = exponential(between(used, turns, frames)) @ before
    scales = np.exp(between(used, np.log(found.scales)[:, None], frames)[:, 0])
    covariance = found.covariance if len(used) == frames else found.covariance.stretched(used, frames)
    view = replace(view, depth=depth_map(rotations, scales, covariance))
    gram, translations, sample = corrected_moments(view, normalized)
    read_only(rotations)
    return replace(
        estimate, rotations=rotations, gram=gram, translations=translations, sample=sample, perspective=view
    )  # fmt: skip


def between(used: NDArray[np.intp], values: Floats, frames: int) -> Floats:
    """Return values of all frames, interpolated between those of the frames used, shape `(F, n)`."""
    return np.stack([np.interp(np.arange(frames), used, each) for each in values.T], axis=1)

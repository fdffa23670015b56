"""Camera estimation under perspective: the cycle tracks → cameras and covariance → depths → corrected tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import Perspective, corrected_moments, depth_map, mirrored
from pliant.solver.cameras.planar_ambiguity import is_planar
from pliant.solver.model.marginal_likelihood import UNLIKELY
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import MIRROR
from pliant.solver.records import Floats, read_only
from pliant.solver.refinement.affine_iterations import affine_iterations
from pliant.solver.refinement.bas_relief import LOG_DEPTH_STD
from pliant.solver.refinement.depth_alternation import alternate, refactorize
from pliant.solver.refinement.evidence import Evidence
from pliant.solver.refinement.focal_length import search
from pliant.solver.refinement.learned import Learned, Refinement, to_all_frames
from pliant.solver.tracks.completion import briefly_hidden

RESTARTS = 3
"""Maximum number of restarts of the alternation from cameras of the corrected tracks; the evidence converges after one or two."""

MIN_GAIN = 0.01
"""Decrease of the energy, per point and frame, below which no further restart is tried and another start is not preferred: equal solutions
from different starts differ by as much."""


def correct_perspective(evidence: Evidence, how: Refinement) -> Evidence:
    """Return the evidence with κ determined and the tracks corrected; if κ is 0 or depths diverge, only `perspective` is updated.

    Parameters
    ----------
    evidence : Evidence
        Uncorrected tracks; `perspective` has the given parameters. The starting scales are those of the estimate.
    how : Refinement
        What is refined; scales are if any differs from 1.
    """
    estimate, used = evidence.estimate, evidence.used
    assert estimate.perspective is not None
    sample = estimate.sample + (estimate.perspective.offsets + estimate.translations)[:, None]
    briefly = briefly_hidden(evidence.normalized.visible)[estimate.sampled]
    view = replace(
        estimate.perspective, filling=estimate.filling, learning_sample=sample[:, briefly], full_sample=sample
    )
    cameras = view.learning_sample[used], evidence.rotations, evidence.start_scales[used]
    view, found = search(*cameras, view, how)
    if not view.is_perspective:
        return replace(evidence, estimate=replace(estimate, perspective=view))
    reached, best = _correct_from(evidence, found, view, how)
    if how.turning and not is_planar(reached.estimate.gram):
        reached, best = _restart(reached, best, how)
        start = affine_iterations(*cameras, view, how)
        if start is not None:
            found, inverse_focal = start
            other = replace(view, inverse_focal=inverse_focal)
            again, found = _restart(*_correct_from(evidence, found, other, how), how)
            reached, best = (again, found) if found.energy < best.energy - MIN_GAIN else (reached, best)
    if best.energy >= UNLIKELY:  # the depths diverge, so no tracks can be corrected with them
        return replace(evidence, estimate=replace(estimate, perspective=replace(view, inverse_focal=0.0)))
    return reached


def _correct_from(evidence: Evidence, found: Learned, view: Perspective, how: Refinement) -> tuple[Evidence, Learned]:
    """Return the evidence with the tracks corrected after alternation from `found` and κ, with κ positive where z points away.

    If the depths diverge, the energy is at least `UNLIKELY`, and the tracks are not corrected.
    """
    if view.inverse_focal * view.signs[0] < 0:
        view = replace(view, inverse_focal=-view.inverse_focal, flipped=-1)
        turned, covariance = mirrored(found.rotations, found.covariance)
        found = replace(found, rotations=turned, covariance=covariance)
        estimate = evidence.estimate
        estimate = replace(estimate, rotations=MIRROR @ estimate.rotations @ MIRROR)
        evidence = replace(evidence, estimate=estimate)
    found, view = alternate(view, found, evidence.used, how)
    if found.energy >= UNLIKELY:
        return evidence, found
    return _with_corrected_tracks(evidence, found, view), found


def _restart(evidence: Evidence, found: Learned, how: Refinement) -> tuple[Evidence, Learned]:
    """Return the evidence after alternations from cameras of the corrected tracks, repeated while the likelihood rises.

    `found` holds the estimate's cameras and covariance at the frames used, and is returned refined. If its depths diverge, no
    restart is tried.
    """
    used, scales = evidence.used, evidence.start_scales
    for _ in range(RESTARTS if found.energy < UNLIKELY else 0):
        view = evidence.estimate.perspective
        assert view is not None
        rotations = refactorize(scales, view, found, used, how)
        if rotations is None:
            break
        other, moved = alternate(view, replace(found, rotations=rotations[used]), used, how)
        gain = found.energy - other.energy
        if gain <= 0:
            break
        evidence = replace(evidence, estimate=replace(evidence.estimate, rotations=rotations))
        evidence, found = _with_corrected_tracks(evidence, other, moved), other
        if gain < MIN_GAIN:
            break
    return evidence, found


def update_correction(evidence: Evidence, found: Learned, how: Refinement) -> tuple[Evidence, Learned]:
    """Return the evidence with tracks corrected for refined cameras and covariance `found`, and these refined once more.

    If the depths diverge, both are returned unchanged.
    """
    view, scales = evidence.estimate.perspective, evidence.start_scales[evidence.used]
    assert view is not None
    absolute = replace(found, scales=found.scales * scales)
    absolute, view = alternate(view, absolute, evidence.used, how)
    if absolute.energy >= UNLIKELY:
        return evidence, found
    return _with_corrected_tracks(evidence, absolute, view), replace(absolute, scales=absolute.scales / scales)


def with_stretched_depth(evidence: Evidence, found: Learned, stretch: float) -> Evidence:
    """Return the evidence with the depths of `found`, λ = `stretch` times the previous ones, and κ/λ, which change the tracks alike.

    The prior on the depth determines κ only as well as the depth.
    """
    view = evidence.estimate.perspective
    assert view is not None
    inverse_focal, std = view.inverse_focal / stretch, (view.inverse_focal_std or 0.0) / stretch
    view = replace(
        view, inverse_focal=inverse_focal, inverse_focal_std=float(np.hypot(std, LOG_DEPTH_STD * inverse_focal))
    )
    return _with_corrected_tracks(
        evidence, replace(found, scales=found.scales * evidence.start_scales[evidence.used]), view
    )


def with_depth_map(
    estimate: CameraEstimate, covariance: ShapeCovariance, rotations: Floats, scales: Floats
) -> CameraEstimate:
    """Return the estimate with D of this covariance and these cameras, in the same axes, if tracks are corrected."""
    view = estimate.perspective
    if view is None or not view.is_perspective:
        return estimate
    depth = depth_map(rotations, scales, covariance)
    return replace(estimate, perspective=replace(view, depth=depth))


def _with_corrected_tracks(evidence: Evidence, found: Learned, view: Perspective) -> Evidence:
    """Return the evidence with the rotations found and the tracks corrected with the depths found; `found` has absolute scales."""
    every = to_all_frames(found, evidence.used, evidence.estimate.rotations)
    view = replace(view, depth=depth_map(every.rotations, every.scales, every.covariance))
    gram, translations, sample = corrected_moments(view, evidence.normalized)
    read_only(every.rotations)
    estimate = replace(
        evidence.estimate, rotations=every.rotations, gram=gram, translations=translations, sample=sample, perspective=view
    )  # fmt: skip
    return evidence.corrected(estimate)

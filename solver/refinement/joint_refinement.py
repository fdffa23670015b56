"""Joint refinement of cameras and shape covariance by the marginal likelihood of the tracks.

Rotations estimated without a model of the deformation absorb part of it as camera motion. With a learned covariance
(`model.shape_covariance`) the likelihood determines both (`model.marginal_likelihood`, without its penalty on rough
modes, which the random walk replaces); they are refined alternately.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import mirrored
from pliant.solver.model import full_mode_covariance
from pliant.solver.model.expectation_maximisation import MAX_MODES, ModelOrder
from pliant.solver.model.model_order import select_model_order
from pliant.solver.model.resection import rotations_between
from pliant.solver.model.so3 import MIRROR, angles_between
from pliant.solver.monitor import enter
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, read_only
from pliant.solver.refinement.bas_relief import at_probable_depth, bulges, is_typical
from pliant.solver.refinement.covariance_learning import LearningData
from pliant.solver.refinement.depth_rounds import correct_perspective, update_correction, with_stretched_depth
from pliant.solver.refinement.evidence import Evidence
from pliant.solver.refinement.free_scales import SCALE_ROUNDS, ScaleTrial, try_free_scales
from pliant.solver.refinement.learned import Learned, Refinement, scene_at
from pliant.solver.refinement.observed import Moments, Observed, on_observations
from pliant.solver.refinement.starts import best_candidate, best_start
from pliant.solver.stages import REFINEMENT_UNITS, UNITS_PER_START
from pliant.solver.tracks.frame_selection import between
from pliant.solver.tracks.normalization import Normalized

REFINEMENT_ROUNDS = 5
"""Refinements of rotations and covariance, each with a new L-BFGS memory. EM in between would undo part of the gain,
since it keeps modes and random walk apart."""

COUPLED_ROUNDS = 2
"""Refinements after the fit of the coupled modes."""


def refine_cameras(
    estimate: CameraEstimate,
    normalized: Normalized,
    shown: NDArray[np.bool_],
    *,
    turning: bool,
    estimates_scales: bool = False,
    seed: int = 0,
    y_up: bool = False,
    should_stop: ShouldStop = never,
) -> tuple[CameraEstimate, LearningData]:
    """Return the cameras, refined if `turning`, and the data from which the shape covariance of all frames is learned.

    Parameters
    ----------
    estimate : CameraEstimate
        Starting cameras, with the Gram matrix and the sample of the completed tracks.
    normalized : Normalized
        The uncompleted tracks, from which perspective and hidden entries are estimated.
    shown : array, shape (F,)
        Frames that show enough points to learn from; the others are interpolated.
    turning : bool
        False keeps the rotations, except for the sign of depth.
    estimates_scales : bool
        True frees scales that are all 1 if that gains more likelihood than chance.
    seed : int
        Seed of the split of the points for held-out scores.
    y_up : bool
        Whether y points up in the images.
    should_stop : callable, optional
        Called between refinements; once it returns True, the best so far is returned.
    """
    evidence = Evidence.of(estimate, normalized, np.flatnonzero(shown), estimate.scales)
    enter(should_stop, "model_order")
    model_order = select_model_order(
        evidence.sample, evidence.projections, ordered=estimate.ordered, seed=seed, should_stop=should_stop
    )
    how = Refinement(model_order, turning=turning, should_stop=should_stop)
    estimates_scales = estimates_scales and bool((evidence.start_scales == 1).all())
    if not turning:
        return _with_kept_rotations(evidence, how, estimates_scales=estimates_scales)
    start, trial = _choose_start(evidence, how), None
    if estimates_scales:
        enter(should_stop, "scales")
        trial = try_free_scales(start.gram, start.rotations, how)
        how = replace(how, with_scales=trial.start is not None)
    evidence, found = _refined(start, trial, how)
    if estimate.filling is not None and np.isfinite(found.energy):
        evidence, found = _of_observations(evidence, found, how)
        # The order limits the modes of completed tracks; expected moments include the uncertainty of hidden entries. Errors
        # without and with the limit: shark with all errors .063 and .088, face landmarks .027 and .024.
        model_order = replace(model_order, max_modes=MAX_MODES)
    estimate, rotations = _of_all_frames(start, evidence, found, trial)
    if not evidence.is_perspective and not bulges(found, evidence.sample, y_up=y_up):
        estimate, rotations, found = _mirrored(estimate, rotations, found)
    return estimate, LearningData(
        evidence.gram, evidence.sample, found.projections, evidence.used, model_order,
        covariance=None if np.isfinite(found.energy) else found.covariance,
        rotations=rotations, scales=estimate.scales, turned=True,
    )  # fmt: skip


def _with_kept_rotations(
    uncorrected: Evidence, how: Refinement, *, estimates_scales: bool
) -> tuple[CameraEstimate, LearningData]:
    """Return what `refine_cameras` does if the rotations are kept."""
    evidence = _choose_start(uncorrected, how)
    if estimates_scales:
        evidence = _with_free_scales(evidence, uncorrected, how)
    if evidence.estimate.filling is not None:
        found = how.learn(evidence.gram, evidence.rotations, np.ones(len(evidence.used)))
        evidence, _ = _of_observations(evidence, found, how)
    estimate = evidence.estimate
    return estimate, LearningData(
        evidence.gram, evidence.sample, evidence.projections, evidence.used, how.model_order, covariance=None,
        rotations=estimate.rotations, scales=estimate.scales, turned=False,
    )  # fmt: skip


def _choose_start(start: Evidence, how: Refinement) -> Evidence:
    """Return the most probable start, with tracks corrected for perspective if needed."""
    should_stop = how.should_stop
    if how.turning and (others := len(start.estimate.hypotheses) + len(start.estimate.candidates)):
        enter(should_stop, "starts", units=UNITS_PER_START * (1 + others))
        start = replace(start, estimate=best_start(start, how))
    if start.estimate.perspective is None:
        return start
    enter(should_stop, "perspective")
    return correct_perspective(start, how)


def _with_free_scales(corrected: Evidence, uncorrected: Evidence, how: Refinement) -> Evidence:
    """Return the evidence for given rotations, with free scales if they gain more likelihood than chance.

    With free scales, the uncorrected tracks are corrected for perspective again.
    """
    should_stop = how.should_stop
    enter(should_stop, "scales")
    trial = try_free_scales(corrected.gram, corrected.rotations, how)
    if trial.start is None:
        return replace(corrected, estimate=_with_scale_reason(corrected.estimate, trial))
    scales = _at_all_frames(corrected.used, trial.start, len(corrected.start_scales))
    estimate = replace(_with_scale_reason(uncorrected.estimate, trial), scales=scales)
    return _choose_start(Evidence.of(estimate, corrected.normalized, corrected.used, scales), how)


def _with_scale_reason(estimate: CameraEstimate, trial: ScaleTrial) -> CameraEstimate:
    return replace(estimate, reasons={**estimate.reasons, "scales": trial.reason})


def _at_all_frames(used: NDArray[np.intp], scales: Floats, frames: int) -> Floats:
    """Return scales of the frames used, interpolated to all, mean logarithm 0, shape `(F,)`, read-only."""
    logs = between(used, np.log(scales), frames)
    found: Floats = np.exp(logs - logs.mean())
    read_only(found)
    return found


def _refined(evidence: Evidence, trial: ScaleTrial | None, how: Refinement) -> tuple[Evidence, Learned]:
    """Return the tracks, corrected with the refined depths, and the refined cameras and covariance of the frames used."""
    estimate, is_perspective, should_stop = evidence.estimate, evidence.is_perspective, how.should_stop
    may_couple = how.model_order == ModelOrder(ordered=estimate.ordered)
    enter(should_stop, "refinement", units=REFINEMENT_UNITS[may_couple])
    found = _first_rounds(evidence, trial, how)
    if is_perspective:
        evidence, found = update_correction(evidence, found, how)
    if may_couple and full_mode_covariance.is_identifiable(found.covariance, estimate.sample.shape[1]):
        found = _coupled(evidence.gram, found, how)
        if is_perspective:
            evidence, found = update_correction(evidence, found, how)
    if not np.isfinite(found.energy):
        return evidence, found
    return _with_probable_focal(evidence, found) if is_perspective else _with_probable_depth(evidence, found, how)


def _first_rounds(evidence: Evidence, trial: ScaleTrial | None, how: Refinement) -> Learned:
    """Return cameras and covariance after `REFINEMENT_ROUNDS`, including those of the scale trial if it used the same frames."""
    count = len(evidence.used)
    if trial is not None and trial.start is None and len(trial.fixed.rotations) == count:
        return how.refine(evidence.gram, trial.fixed, rounds=REFINEMENT_ROUNDS - SCALE_ROUNDS)
    scales = np.ones(count) if trial is None or trial.start is None else trial.start
    found = how.learn(evidence.gram, evidence.rotations, scales)
    return how.refine(evidence.gram, found, rounds=REFINEMENT_ROUNDS)


def _with_probable_depth(evidence: Evidence, found: Learned, how: Refinement) -> tuple[Evidence, Learned]:
    """Return cameras and covariance at the most probable depth; if the tracks hardly determine it, the best of all candidates."""
    found, stretch = at_probable_depth(evidence.gram, found)
    evidence = replace(evidence, estimate=_with_depth_choice(evidence.estimate, stretch))
    if evidence.estimate.depth_is_typical:
        found = best_candidate(evidence, found, how)
    return evidence, found


def _with_probable_focal(evidence: Evidence, found: Learned) -> tuple[Evidence, Learned]:
    """Return tracks, cameras and covariance at the most probable depth and the focal length that belongs to it.

    λ times the depth, seen with λ times the focal length, shows the same perspective. If the tracks or a given focal length determine the
    depth, nothing changes.
    """
    view = evidence.estimate.perspective
    assert view is not None
    if view.given is not None:
        return evidence, found
    moved, stretch = at_probable_depth(evidence.gram, found)
    if not is_typical(stretch):
        return evidence, found
    evidence = with_stretched_depth(evidence, moved, stretch)
    return replace(evidence, estimate=_with_depth_choice(evidence.estimate, stretch)), moved


def _mirrored(estimate: CameraEstimate, rotations: Floats, found: Learned) -> tuple[CameraEstimate, Floats, Learned]:
    """Return the estimate, its rotations in the axes of `found`, and `found`, all mirrored in depth."""
    ours, other = (MIRROR @ np.asarray(each) @ MIRROR for each in (estimate.rotations, rotations))
    read_only(ours)
    own, covariance = mirrored(found.rotations, found.covariance)
    return replace(estimate, rotations=ours), other, replace(found, rotations=own, covariance=covariance)


def _of_all_frames(
    start: Evidence, evidence: Evidence, found: Learned, trial: ScaleTrial | None
) -> tuple[CameraEstimate, Floats]:
    """Return the estimate with the cameras found, interpolated to all frames, and its rotations in the axes of `found`."""
    estimate, used, frames = evidence.estimate, evidence.used, len(evidence.start_scales)
    rotations = rotations_between(used, found.rotations, frames)
    if trial is not None:
        estimate = _with_scale_reason(estimate, trial)
    if (found.scales != 1).any():
        estimate = replace(estimate, scales=_at_all_frames(used, found.scales * evidence.start_scales[used], frames))
    return _with_rotation_reason(estimate, rotations, start.estimate.rotations), rotations


def _of_observations(evidence: Evidence, found: Learned, how: Refinement) -> tuple[Evidence, Learned]:
    """Return cameras and covariance estimated from the observations themselves, without hidden or replaced entries."""
    estimate, used, should_stop = evidence.estimate, evidence.used, how.should_stop
    enter(should_stop, "observations")
    translations = np.array(estimate.translations)
    completed = Moments(evidence.gram, evidence.sample, translations[used], estimate.outlier_share)
    observed = Observed.of(evidence.normalized, estimate, used)
    found, moments, view = on_observations(observed, found, completed, evidence.start_scales[used], how)
    translations[used] = moments.translations
    estimate = replace(estimate, translations=translations)
    if view is not None:
        assert estimate.perspective is not None
        view = replace(estimate.perspective, inverse_focal=view.inverse_focal, inverse_focal_std=view.inverse_focal_std)
        estimate = replace(estimate, perspective=view)
    return replace(evidence, estimate=estimate, gram=moments.gram, sample=moments.sample), found


def _coupled(gram: Floats, found: Learned, how: Refinement) -> Learned:
    """Return the cameras refined with a covariance between modes (`model.full_mode_covariance`), if they are more probable."""
    scene = scene_at(gram, found.rotations, with_scales=how.with_scales, ordered=found.covariance.ordered)
    cameras = full_mode_covariance.refined(scene, found.scales, found.covariance, should_stop=how.should_stop)
    again = how.refine(gram, how.learn(gram, *cameras), rounds=COUPLED_ROUNDS)
    return again if again.energy < found.energy else found


def _with_rotation_reason(estimate: CameraEstimate, rotations: Floats, before: Floats) -> CameraEstimate:
    """Return the estimate with new rotations, relative to the first frame, and a sentence about the change."""
    rotations = rotations @ rotations[0].T
    turn = float(np.degrees(angles_between(rotations, before).mean()))
    sentence = f"Then refined together with the covariance of the shapes; rotations moved by {turn:.2f}° on average."
    known = estimate.reasons.get("rotations", "")
    read_only(rotations)
    return replace(
        estimate, rotations=rotations, reasons={**estimate.reasons, "rotations": f"{known} {sentence}".strip()}
    )


def _with_depth_choice(estimate: CameraEstimate, stretch: float) -> CameraEstimate:
    """Return the estimate, with a sentence if the prior determines the extent of depth."""
    if not is_typical(stretch):
        return estimate
    sentence = (
        f"The tracks hardly distinguish depth from rotation: {1 / stretch:.2g} times the depth with {stretch:.2g} times the rotation "
        "explains them about as well. A depth typical for the width is assumed, like that of half a sphere."
    )
    if estimate.perspective is not None and estimate.perspective.is_perspective:
        sentence += " The focal length shows the tracks' perspective at this depth."
    return replace(estimate, depth_is_typical=True, reasons={**estimate.reasons, "depth_extent": sentence})

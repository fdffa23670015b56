"""Joint refinement of cameras and shape covariance by the marginal likelihood of the tracks.

Rotations estimated without a model of the deformation absorb part of it as camera motion. With a learned covariance
(`model.shape_covariance`) the likelihood determines both (`model.marginal_likelihood`, without its penalty on rough
modes, which the random walk replaces); they are improved alternately.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.bas_relief import DECIDED, facing, settled_depth
from pliant.solver.cameras.covariance_learning import LearningData
from pliant.solver.cameras.depth_rounds import settled, settled_again
from pliant.solver.cameras.estimation import CameraEstimate, restarted
from pliant.solver.cameras.learned import Learned, motion_of, moved_to, scene_at
from pliant.solver.cameras.scale import WIDEST, rigid_scales
from pliant.solver.model import full_mode_covariance
from pliant.solver.model.expectation_maximisation import MAX_MODES, learned
from pliant.solver.model.marginal_likelihood import fit
from pliant.solver.model.model_order import ModelOrder, select_model_order
from pliant.solver.model.so3 import angles_between, exponential
from pliant.solver.monitor import enter
from pliant.solver.records import Floats, read_only
from pliant.solver.stages import REFINEMENT_UNITS, UNITS_PER_START
from pliant.solver.tracks.noise import OUTLIER_SHARE
from pliant.solver.tracks.normalization import Normalized
from scipy.spatial.transform import Rotation

REFINEMENT_ROUNDS = 5
"""Refinements of rotations and covariance, each with a new L-BFGS memory. EM in between would undo part of the gain,
since it keeps modes and random walk apart."""

START_EM_ROUNDS = 90
"""Maximum number of EM rounds of a run before a refinement; L-BFGS, which follows, gains more in the same time. Error of faces
of 99 frames with 60, 90 and 150: .0146, .0132, .0138, differences that may be chance."""

ROTATION_ITERATIONS = 60
"""L-BFGS iterations per refinement of the rotations."""

START_FRAMES, START_ROUNDS = 40, 2
"""Frames and refinements used to compare the starting cameras."""

CANDIDATE_ROUNDS = 3
"""Refinements of every candidate where they are compared at settled depths."""

SCALE_FRAMES = 120
"""Frames used to decide whether scales are free; with 60 instead of 120 chance gains of fixed scales reach .054."""

SCALE_ROUNDS = 2
"""Refinements used to decide whether scales are free."""

MIN_SCALE_GAIN = 0.12
"""Decrease of the energy, per point and frame, required to free scales that vary from frame to frame. BIC for one
parameter per frame gives .075; fixed scales gain up to .08 by chance, real scale changes .23 and more."""

SMOOTH_SCALE_SHARE = 0.4
"""Share of `MIN_SCALE_GAIN` required of slowly varying scales, which need fewer parameters: a swing of .05 over 60
frames gains .058, none up to .04."""

MIN_SCALE_STD = 0.01
"""Standard deviation of log s below which scales stay 1."""


def refine_cameras(
    estimate: CameraEstimate,
    shown: NDArray[np.bool_],
    *,
    turning: bool,
    estimates_scales: bool = False,
    seed: int = 0,
    normalized: Normalized | None = None,
    y_up: bool = False,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[CameraEstimate, LearningData]:
    """Return the cameras, refined if `turning`, and what the shape covariance of all frames is learned from.

    Parameters
    ----------
    estimate : CameraEstimate
        Where to start, with the Gram matrix and the sample of the completed tracks; its translations are kept.
    shown : array, shape (F,)
        Frames that show enough points to learn from; the others are interpolated.
    turning : bool
        False keeps the cameras fixed.
    estimates_scales : bool
        True frees scales that are all 1 if that gains more likelihood than chance.
    seed : int
        Seed of the split of the points where some are held out.
    normalized : Normalized, optional
        The tracks themselves, needed where `estimate.perspective` says that perspective is possible.
    y_up : bool
        Whether y points up in the images.
    should_stop : callable, optional
        Called between refinements; once it returns True, the best so far is returned.
    """
    frames, spoiled = len(estimate.rotations), estimate.outliers > OUTLIER_SHARE
    used = np.flatnonzero(shown)
    start = np.asarray(estimate.scales)
    unscaled, sample = _of_corrected(estimate, start, used)
    enter(should_stop, "model_order")
    model_order = select_model_order(
        sample,
        np.asarray(estimate.rotations)[used, :2],
        spoiled=spoiled and not turning,
        ordered=estimate.ordered,
        seed=seed,
        should_stop=should_stop,
    )
    if spoiled and turning:
        # Few modes would let the cameras follow the deformation; the order is selected later, for the shapes.
        model_order = replace(model_order, max_modes=MAX_MODES)
    if turning and estimate.hypotheses:
        enter(should_stop, "starts", units=UNITS_PER_START * (1 + len(estimate.hypotheses)))
        estimate = _best_start(estimate, unscaled, used, model_order, should_stop)
    if estimate.perspective is not None and normalized is not None:
        enter(should_stop, "perspective")
        estimate = settled(
            estimate, normalized, used, model_order=model_order, turning=turning, should_stop=should_stop
        )
        unscaled, sample = _of_corrected(estimate, start, used)
    at_first = np.asarray(estimate.rotations)
    before = at_first[used]
    start_scales, why, fixed = None, None, None
    if turning and estimates_scales and (start == 1).all():
        enter(should_stop, "scales")
        start_scales, why, fixed = _free_scales(unscaled, before, model_order, should_stop)
    rotations, scales, found = before, np.ones(len(used)), None
    if turning:
        may_couple = model_order == ModelOrder(ordered=estimate.ordered)
        enter(should_stop, "refinement", units=REFINEMENT_UNITS[may_couple])
        if fixed is None or start_scales is not None or len(fixed.rotations) < len(used):
            found = refined(
                unscaled, before, scales if start_scales is None else start_scales, with_scales=start_scales is not None,
                rounds=REFINEMENT_ROUNDS, model_order=model_order, should_stop=should_stop,
            )  # fmt: skip
        else:
            rounds = REFINEMENT_ROUNDS - SCALE_ROUNDS
            found = _turned(unscaled, fixed, with_scales=False, rounds=rounds, should_stop=should_stop)
        bends = estimate.perspective is not None and estimate.perspective.bends

        def again(found: Learned) -> tuple[CameraEstimate, Learned, Floats, Floats]:
            assert normalized is not None
            better, moved = settled_again(
                estimate, normalized, used, found, start[used], model_order=model_order, should_stop=should_stop
            )
            return better, moved, *_of_corrected(better, start, used)

        if bends:
            estimate, found, unscaled, sample = again(found)
        if may_couple and full_mode_covariance.is_identifiable(found.covariance, estimate.sample.shape[1]):
            found = _coupled(unscaled, found, with_scales=start_scales is not None, should_stop=should_stop)
            if bends:
                estimate, found, unscaled, sample = again(found)
        if not bends and np.isfinite(found.energy):
            found, stretch = settled_depth(unscaled, found)
            estimate = _with_depth_choice(estimate, stretch)
            if estimate.depth_is_typical:
                found = _steadiest(estimate, unscaled, used, found, model_order, should_stop)
                found = facing(found, sample, y_up=y_up)
        before = np.asarray(estimate.rotations)[used] if bends else before
        rotations, scales = found.rotations, found.scales
    stopped = found.covariance if found is not None and not np.isfinite(found.energy) else None
    projections = rotations[:, :2] * scales[:, None, None]
    data = LearningData(
        unscaled, sample, projections, used, model_order, spoiled and turning, stopped,
        np.asarray(estimate.rotations), np.asarray(estimate.scales), turning,
    )  # fmt: skip
    if not turning:
        return estimate, data
    turns = Rotation.from_matrix(rotations @ before.transpose(0, 2, 1)).as_rotvec()
    whole = exponential(_between(used, turns, frames)) @ estimate.rotations
    if why is not None:
        estimate = replace(estimate, reasons={**estimate.reasons, "scales": why})
    if start_scales is not None:
        logs = _between(used, np.log(scales)[:, None], frames)[:, 0]
        scales = np.exp(logs - logs.mean())
        read_only(scales)
        estimate = replace(estimate, scales=scales)
    data = replace(data, rotations=whole, scales=np.asarray(estimate.scales))
    return _with_rotation_reason(estimate, whole, at_first), data


def _of_corrected(estimate: CameraEstimate, scales: Floats, used: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return Gram matrix and sample of the frames used, divided by the scales."""
    unscaled = _of_frames(estimate.gram / np.outer(np.repeat(scales, 2), np.repeat(scales, 2)), used)
    return unscaled, (estimate.sample / scales[:, None, None])[used]


def refined(
    gram: Floats,
    rotations: Floats,
    scales: Floats,
    *,
    with_scales: bool,
    rounds: int,
    model_order: ModelOrder,
    should_stop: Callable[[], bool] | None = None,
) -> Learned:
    """Return cameras and covariance after rounds of alternating refinement; scales stay 1 without `with_scales`."""
    start = _learned_at(gram, rotations, scales, model_order, should_stop)
    return _turned(gram, start, with_scales=with_scales, rounds=rounds, should_stop=should_stop)


def _learned_at(
    gram: Floats,
    rotations: Floats,
    scales: Floats,
    model_order: ModelOrder,
    should_stop: Callable[[], bool] | None,
) -> Learned:
    """Return given cameras and the covariance learned with them from scratch."""
    covariance = learned(
        gram,
        rotations[:, :2] * scales[:, None, None],
        max_modes=model_order.max_modes,
        noisy_start=model_order.noisy_start,
        ordered=model_order.ordered,
        iterations=START_EM_ROUNDS,
        should_stop=should_stop,
    )
    return Learned(rotations, scales, covariance, np.inf)


def _turned(
    gram: Floats, found: Learned, *, with_scales: bool, rounds: int, should_stop: Callable[[], bool] | None
) -> Learned:
    """Return cameras and covariance after rounds of refinement."""
    for _ in range(rounds):
        if should_stop is not None and should_stop():
            break
        found = turned_once(gram, found, with_scales=with_scales, should_stop=should_stop)
    return found


def _best_start(
    estimate: CameraEstimate,
    gram: Floats,
    used: NDArray[np.intp],
    model_order: ModelOrder,
    should_stop: Callable[[], bool] | None,
) -> CameraEstimate:
    """Return the estimate with the rotations, its own or a hypothesis's, that give the lowest energy after a short refinement.

    The multistart models deformation by smooth modes and moves cameras by degrees to fit it; joint refinement hardly
    moves them back, because every mode would have to move along. The unrefined cameras of a factorization can
    therefore be the better start.
    """
    some = evenly_spread(np.arange(len(used)), START_FRAMES)
    part, ones = _of_frames(gram, some), np.ones(len(some))
    best, lowest = estimate, np.inf
    for start in (estimate, *(restarted(estimate, size, rotations) for size, rotations in estimate.hypotheses)):
        if should_stop is not None and should_stop():
            break
        given = np.asarray(start.rotations)[used[some]]
        found = refined(
            part, given, ones, with_scales=False, rounds=START_ROUNDS, model_order=model_order, should_stop=should_stop
        )
        if found.energy < lowest:
            best, lowest = start, found.energy
    return best


def _steadiest(
    estimate: CameraEstimate,
    gram: Floats,
    used: NDArray[np.intp],
    found: Learned,
    model_order: ModelOrder,
    should_stop: Callable[[], bool] | None,
) -> Learned:
    """Return the most probable cameras among `found` and those from every candidate of the multistart, each at its settled depth.

    Rotations that are too small by different factors are not equally steady; only at comparable depths does steadiness tell a turn of the
    object from its deformation.
    """
    for rotations in estimate.candidates:
        if should_stop is not None and should_stop():
            break
        other = refined(
            gram, np.asarray(rotations)[used], found.scales, with_scales=False, rounds=CANDIDATE_ROUNDS,
            model_order=model_order, should_stop=should_stop,
        )  # fmt: skip
        if not np.isfinite(other.energy):
            break
        other, _ = settled_depth(gram, other)
        found = min(found, other, key=lambda each: each.energy)
    return found


def _free_scales(
    gram: Floats, rotations: Floats, model_order: ModelOrder, should_stop: Callable[[], bool] | None
) -> tuple[Floats | None, str, Learned]:
    """Return scales to start from, or None where free scales gain no more than chance, a sentence, and what was found without.

    Scales are free from two starts, 1 and those of a rigid shape, on a subset of the frames. Deformation that is
    mistaken for scale ends in a worse minimum than fixed scales, or in one with nearly constant scales.
    """
    used = evenly_spread(np.arange(len(rotations)), SCALE_FRAMES)
    part, given, none = _of_frames(gram, used), rotations[used], np.ones(len(used))

    def turned(start: Learned, *, with_scales: bool) -> Learned:
        return _turned(part, start, with_scales=with_scales, rounds=SCALE_ROUNDS, should_stop=should_stop)

    even, rigid = (
        _learned_at(part, given, scales, model_order, should_stop) for scales in (none, rigid_scales(part, given))
    )
    fixed, runs = turned(even, with_scales=False), [turned(each, with_scales=True) for each in (even, rigid)]
    best = min(runs, key=lambda run: run.energy)
    gain, least, largest = fixed.energy - best.energy, float(best.scales.min()), float(best.scales.max())
    if np.log(best.scales).std() > WIDEST:
        return (
            None,
            f"Every scale is 1: those found, from {least:.3f} to {largest:.3f}, are wider apart than any camera's.",
            fixed,
        )
    share = _scale_gain_share(np.log(best.scales)) if model_order.ordered else 1.0
    if not (gain > MIN_SCALE_GAIN * share and np.log(best.scales).std() > MIN_SCALE_STD):
        why = (
            f"Every scale is 1: free ones, from {least:.3f} to {largest:.3f}, would gain {gain:.3f} in the logarithm of the "
            "likelihood, no more than deformation alone does."
        )
        return None, why, fixed
    logs = _between(used, np.log(best.scales)[:, None], len(rotations))[:, 0]
    why = f"Scales from {least:.3f} to {largest:.3f} gain {gain:.3f} in the logarithm of the likelihood, per point and frame."
    return np.exp(logs - logs.mean()), why, fixed


def _scale_gain_share(logs: Floats) -> float:
    """Return the share of `MIN_SCALE_GAIN` required: `SMOOTH_SCALE_SHARE` for slowly varying scales, up to 1 for independent ones."""
    rough = float(np.diff(logs).var()) / max(2 * float(logs.var()), np.finfo(float).tiny)
    return float(np.clip(3 * rough, SMOOTH_SCALE_SHARE, 1.0))


def evenly_spread(places: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return at most `count` of the places, evenly spread."""
    chosen = np.linspace(0, len(places) - 1, min(len(places), count)).round().astype(np.intp)
    return np.asarray(places[np.unique(chosen)])


def _of_frames(gram: Floats, used: NDArray[np.intp]) -> Floats:
    """Return the Gram matrix of some frames."""
    rows = np.stack([2 * used, 2 * used + 1], axis=1).ravel()
    return gram[np.ix_(rows, rows)]


def informative_frames(visible: Floats) -> NDArray[np.bool_]:
    """Return which frames show at least a tenth of the median number of points, shape `(F,)`; all if fewer than three do."""
    seen = (visible > 0).sum(axis=1)
    is_identifiable = np.asarray(seen >= max(3.0, 0.1 * float(np.median(seen[seen > 0]))))
    return is_identifiable if is_identifiable.sum() >= 3 else np.ones(len(seen), dtype=bool)


def turned_once(
    gram: Floats,
    found: Learned,
    *,
    with_scales: bool,
    factor: Floats | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Learned:
    """Return cameras and covariance of higher likelihood; `factor` as for `scene_at`."""
    ordered = found.covariance.ordered
    scene = scene_at(gram, found.rotations, with_scales=with_scales, ordered=ordered, factor=factor)
    moved = fit(scene, motion_of(scene, found), iterations=ROTATION_ITERATIONS, turning=True, should_stop=should_stop)
    return moved_to(scene, found, *moved)


def _coupled(gram: Floats, found: Learned, *, with_scales: bool, should_stop: Callable[[], bool] | None) -> Learned:
    """Return the cameras refined with modes that have axes of their own (`model.full_mode_covariance`), if they are more probable."""
    scene = scene_at(gram, found.rotations, with_scales=with_scales, ordered=found.covariance.ordered)
    rotations, scales = full_mode_covariance.refined(scene, found.scales, found.covariance, should_stop=should_stop)
    again = refined(
        gram, rotations, scales, with_scales=with_scales, rounds=START_ROUNDS,
        model_order=ModelOrder(ordered=scene.ordered), should_stop=should_stop,
    )  # fmt: skip
    return again if again.energy < found.energy else found


def _between(used: NDArray[np.intp], turns: Floats, frames: int) -> Floats:
    """Return turns of all frames, interpolated between those of the frames used."""
    return np.stack([np.interp(np.arange(frames), used, axis) for axis in turns.T], axis=1)


def _with_rotation_reason(estimate: CameraEstimate, rotations: Floats, before: Floats) -> CameraEstimate:
    """Return the estimate with new rotations, the first of them the identity, and a sentence about it."""
    rotations = rotations @ rotations[0].T
    turn = float(np.degrees(angles_between(rotations, before).mean()))
    sentence = f"Then refined together with the covariance of the shapes; rotations moved by {turn:.2f}° on average."
    known = estimate.reasons.get("rotations", "")
    read_only(rotations)
    return replace(
        estimate, rotations=rotations, reasons={**estimate.reasons, "rotations": f"{known} {sentence}".strip()}
    )


def _with_depth_choice(estimate: CameraEstimate, stretch: float) -> CameraEstimate:
    """Return the estimate, with a sentence where the tracks leave the extent of depth to the prior: λ or 1/λ is at least `DECIDED`."""
    if abs(np.log(stretch)) < np.log(DECIDED):
        return estimate
    sentence = (
        f"The tracks hardly tell depth from rotation: {1 / stretch:.2g} times the depth with {stretch:.2g} times the rotation explains "
        "them about as well. The depth is one that is usual for the width, as of half a sphere."
    )
    return replace(estimate, depth_is_typical=True, reasons={**estimate.reasons, "depth_extent": sentence})

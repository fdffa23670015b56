"""Cameras and shape covariance together: each is refined for the other, by the likelihood of the tracks alone.

Rotations chosen before anything is known of the deformation take part of it for camera motion. With the covariance learned
(`model.shape_covariance`) the same likelihood says which rotations make the tracks most probable (`model.marginal_likelihood`,
without its penalty on rough modes: the random walk is penalty enough), and both are improved in turn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.depth_rounds import settled, settled_again, with_depth_map
from pliant.solver.cameras.estimation import CameraEstimate, restarted
from pliant.solver.cameras.learned import Learned, motion_of, moved_to, scene_at
from pliant.solver.cameras.scale import WIDEST, rigid_scales
from pliant.solver.model import full_mode_covariance
from pliant.solver.model.early_stopping import described, learned_in_time
from pliant.solver.model.marginal_likelihood import fit
from pliant.solver.model.model_order import Support, supported
from pliant.solver.model.shape_covariance import (
    MOST_MODES,
    ShapeCovariance,
    learned,
)
from pliant.solver.model.so3 import angles_between, exponential
from pliant.solver.records import Floats, read_only
from pliant.solver.tracks.noise import SPOILED
from pliant.solver.tracks.normalization import Normalised
from scipy.spatial.transform import Rotation

LEARNED_FRAMES = 360
"""Longer sequences are learned from this many of their frames, evenly spread: the cost grows with F³."""

ROUNDS = 5
"""Refinements of rotations and covariance, each with a fresh memory of the curvature. Expectation maximisation between them would undo
a part, for it keeps modes and random walk apart, which L-BFGS does not."""

TURNS = 60
"""L-BFGS iterations of one refinement of the rotations."""

START_FRAMES, START_ROUNDS = 40, 2
"""Frames and refinements on which it is decided from which cameras to start."""

ZOOM_FRAMES = 120
"""Frames on which it is decided whether the camera zooms. Few of many say less: of a mocap without any zoom, 1,102 frames with outliers,
hidden points and noise, 60 frames gain .050 to .054 with scales in two draws of three, 120 gain .022 to .036, 180 of one draw lose."""

ZOOM_ROUNDS = 2
"""Refinements on which it is decided."""

ZOOM_GAIN = 0.12
"""Scales that jump from frame to frame are adopted where they gain more than this in the energy: the logarithm of the number of points
that a surface is worth (`marginal_likelihood.STEADINESS`), halved and per point, as Schwarz's criterion asks of one parameter per
frame, is .075, to which chance adds. Measured: -.03 to .08 where there are none (.08 on ten frames of faces, a quarter of it hidden), .23
and more on real bending paper that comes nearer and goes."""

ZOOM_SMOOTH = 0.4
"""Share of it that is asked of scales that change slowly, for they are not one parameter per frame: measured, .058 gained by a zoom that
swings by .05 over 60 frames, up to .04 by none."""

ZOOM_LEAST = 0.01
"""And where the standard deviation of their logarithm is above this: less is not worth a parameter per frame."""


def learn(
    estimate: CameraEstimate,
    shown: NDArray[np.bool_],
    *,
    turning: bool,
    zooming: bool = False,
    seed: int = 0,
    normalised: Normalised | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[CameraEstimate, ShapeCovariance]:
    """Return the cameras, refined if `turning`, and the shape covariance of all frames.

    Parameters
    ----------
    estimate : CameraEstimate
        Where to start, with the Gram matrix and the sample of the completed tracks; its translations are kept.
    shown : array, shape (F,)
        Which frames show enough to learn from; the others are taken to lie between them.
    turning : bool
        False leaves the cameras as they are: given ones, or as the user wished.
    zooming : bool
        True: scales that are all 1 are refined with the rotations, if that makes the tracks more probable than chance does.
    seed : int
        Deals the points out where some are held back to judge what was learned from the others.
    normalised : Normalised, optional
        The tracks themselves, needed where `estimate.perspective` says that perspective is possible.
    should_stop : callable, optional
        Asked between refinements; once it says True, the best so far is returned.
    """
    frames, spoiled = len(estimate.rotations), estimate.outliers > SPOILED
    used = learned_frames(shown)
    start = np.asarray(estimate.scales)
    unscaled, sample = _of_corrected(estimate, start, used)
    support = supported(
        sample,
        np.asarray(estimate.rotations)[used, :2],
        spoiled=spoiled and not turning,
        seed=seed,
        should_stop=should_stop,
    )
    if spoiled and turning:
        # Few modes would let the cameras follow the deformation; what is left of outliers is judged for the shapes.
        support = replace(support, most=MOST_MODES)
    if turning and estimate.rivals:
        estimate = _started(estimate, unscaled, used, support, should_stop)
    if estimate.perspective is not None and normalised is not None:
        estimate = settled(estimate, normalised, used, support=support, turning=turning, should_stop=should_stop)
        unscaled, sample = _of_corrected(estimate, start, used)
    at_first = np.asarray(estimate.rotations)
    before = at_first[used]
    zoom, why = None, None
    if turning and zooming and (start == 1).all():
        zoom, why = _zoom(unscaled, before, support, should_stop)
    rotations, scales, found = before, np.ones(len(used)), None
    if turning:
        found = refined(
            unscaled, before, scales if zoom is None else zoom, with_scales=zoom is not None,
            rounds=ROUNDS, support=support, should_stop=should_stop,
        )  # fmt: skip
        bends = estimate.perspective is not None and estimate.perspective.bends

        def again(found: Learned) -> tuple[CameraEstimate, Learned, Floats, Floats]:
            assert normalised is not None
            better, moved = settled_again(
                estimate, normalised, used, found, start[used], support=support, should_stop=should_stop
            )
            return better, moved, *_of_corrected(better, start, used)

        if bends:
            estimate, found, unscaled, sample = again(found)
        if support == Support() and full_mode_covariance.telling(found.covariance, estimate.sample.shape[1]):
            found = _coupled(unscaled, found, with_scales=zoom is not None, should_stop=should_stop)
            if bends:
                estimate, found, unscaled, sample = again(found)
        before = np.asarray(estimate.rotations)[used] if bends else before
        rotations, scales = found.rotations, found.scales
    if found is not None and not np.isfinite(found.energy):  # stopped
        covariance, modes = found.covariance, described(found.covariance)
    else:
        # From scratch: what the way to these cameras has left in the modes is worth less than it makes the tracks more probable.
        pairs = rotations[:, :2] * scales[:, None, None]
        if spoiled and turning:
            support = supported(sample, pairs, spoiled=True, seed=seed, should_stop=should_stop)
        covariance, modes = learned_in_time(sample, unscaled, pairs, support, seed=seed, should_stop=should_stop)
    if len(used) < frames:
        covariance = covariance.stretched(used, frames)
    estimate = replace(estimate, reasons={**estimate.reasons, "modes": modes})
    if not turning:
        return with_depth_map(estimate, covariance), covariance
    turns = Rotation.from_matrix(rotations @ before.transpose(0, 2, 1)).as_rotvec()
    whole = exponential(_between(used, turns, frames)) @ estimate.rotations
    if why is not None:
        estimate = replace(estimate, reasons={**estimate.reasons, "scales": why})
    if zoom is not None:
        logs = _between(used, np.log(scales)[:, None], frames)[:, 0]
        scales = np.exp(logs - logs.mean())
        read_only(scales)
        estimate = replace(estimate, scales=scales)
    estimate = with_depth_map(replace(estimate, rotations=whole), covariance)
    return _told(estimate, whole, at_first), _seen_from(covariance, whole[0])


def _of_corrected(estimate: CameraEstimate, scales: Floats, used: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return Gram matrix and sample of the frames used, scales undone."""
    unscaled = _of_frames(estimate.gram / np.outer(np.repeat(scales, 2), np.repeat(scales, 2)), used)
    return unscaled, (estimate.sample / scales[:, None, None])[used]


def refined(
    gram: Floats,
    rotations: Floats,
    scales: Floats,
    *,
    with_scales: bool,
    rounds: int,
    support: Support,
    should_stop: Callable[[], bool] | None = None,
) -> Learned:
    """Return cameras and covariance after rounds in which one is refined for the other; scales stay 1 without `with_scales`."""
    pairs = rotations[:, :2] * scales[:, None, None]
    covariance = learned(gram, pairs, most=support.most, noisy=support.noisy, should_stop=should_stop)
    found = Learned(rotations, scales, covariance, np.inf)
    for _ in range(rounds):
        if should_stop is not None and should_stop():
            break
        found = _turn(gram, found, with_scales=with_scales, should_stop=should_stop)
    return found


def _started(
    estimate: CameraEstimate,
    gram: Floats,
    used: NDArray[np.intp],
    support: Support,
    should_stop: Callable[[], bool] | None,
) -> CameraEstimate:
    """Return the estimate with those rotations, its own or a rival's, from which refinement makes some frames most probable.

    The race explains deformation by smooth modes and moves cameras by degrees for it; refinement with the shapes hardly moves them
    back, for every mode has to move with them. Measured on a horse seen by a swinging camera: error .14 from the race's cameras, .012 from
    those of the factorization.
    """
    some = _some(np.arange(len(used)), START_FRAMES)
    part, ones = _of_frames(gram, some), np.ones(len(some))
    best, lowest = estimate, np.inf
    for start in (estimate, *(restarted(estimate, size, rotations) for size, rotations in estimate.rivals)):
        if should_stop is not None and should_stop():
            break
        given = np.asarray(start.rotations)[used[some]]
        found = refined(
            part, given, ones, with_scales=False, rounds=START_ROUNDS, support=support, should_stop=should_stop
        )
        if found.energy < lowest:
            best, lowest = start, found.energy
    return best


def _zoom(
    gram: Floats, rotations: Floats, support: Support, should_stop: Callable[[], bool] | None
) -> tuple[Floats | None, str]:
    """Return scales to start from, or None where those found gain no more than chance, and a sentence.

    Measured on some frames. Scales are free from two starts, 1 and those of a rigid shape: deformation that passes for a zoom ends in
    a worse minimum than no scales, or in one with hardly any.
    """
    used = _some(np.arange(len(rotations)), ZOOM_FRAMES)
    part, given, none = _of_frames(gram, used), rotations[used], np.ones(len(used))

    def energies(scales: Floats, *, with_scales: bool) -> Learned:
        return refined(
            part, given, scales, with_scales=with_scales, rounds=ZOOM_ROUNDS, support=support, should_stop=should_stop
        )

    fixed = energies(none, with_scales=False)
    runs = [energies(scales, with_scales=True) for scales in (none, rigid_scales(part, given))]
    best = min(runs, key=lambda run: run.energy)
    gain, least, largest = fixed.energy - best.energy, float(best.scales.min()), float(best.scales.max())
    if np.log(best.scales).std() > WIDEST:
        return (
            None,
            f"Every scale is 1: those found, from {least:.3f} to {largest:.3f}, are wider apart than any camera's.",
        )
    if not (gain > ZOOM_GAIN * _unsteady(np.log(best.scales)) and np.log(best.scales).std() > ZOOM_LEAST):
        return None, (
            f"Every scale is 1: free ones, from {least:.3f} to {largest:.3f}, would gain {gain:.3f} in the logarithm of the "
            "likelihood, no more than deformation alone does."
        )
    logs = _between(used, np.log(best.scales)[:, None], len(rotations))[:, 0]
    return np.exp(logs - logs.mean()), (
        f"Scales from {least:.3f} to {largest:.3f} gain {gain:.3f} in the logarithm of the likelihood, per point and frame."
    )


def _unsteady(logs: Floats) -> float:
    """Return from `ZOOM_SMOOTH`, for scales that change slowly, to 1 for those that are drawn anew for every frame or third frame."""
    rough = float(np.diff(logs).var()) / max(2 * float(logs.var()), np.finfo(float).tiny)
    return float(np.clip(3 * rough, ZOOM_SMOOTH, 1.0))


def _some(places: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Return at most so many of the places, evenly spread."""
    chosen = np.linspace(0, len(places) - 1, min(len(places), count)).round().astype(np.intp)
    return np.asarray(places[np.unique(chosen)])


def _of_frames(gram: Floats, used: NDArray[np.intp]) -> Floats:
    """Return the Gram matrix of some frames."""
    rows = np.stack([2 * used, 2 * used + 1], axis=1).ravel()
    return gram[np.ix_(rows, rows)]


def learned_frames(shown: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the frames to learn from: at most `LEARNED_FRAMES` of those that show enough."""
    return _some(np.flatnonzero(shown), LEARNED_FRAMES)


def telling_frames(visible: Floats) -> NDArray[np.bool_]:
    """Return which frames show at least a tenth of what the others show, shape `(F,)`; all if hardly any does."""
    seen = (visible > 0).sum(axis=1)
    telling = np.asarray(seen >= max(3.0, 0.1 * float(np.median(seen[seen > 0]))))
    return telling if telling.sum() >= 3 else np.ones(len(seen), dtype=bool)


def _turn(gram: Floats, found: Learned, *, with_scales: bool, should_stop: Callable[[], bool] | None) -> Learned:
    """Return cameras and covariance of higher likelihood."""
    scene = scene_at(gram, found.rotations, with_scales=with_scales)
    moved = fit(scene, motion_of(scene, found), iterations=TURNS, turning=True, should_stop=should_stop)
    return moved_to(scene, found, *moved)


def _coupled(gram: Floats, found: Learned, *, with_scales: bool, should_stop: Callable[[], bool] | None) -> Learned:
    """Return cameras found with modes that have axes of their own (`model.full_mode_covariance`), refined, if that is more probable.

    Measured: without the comparison, 150 frames of an animated head seen in one sweep go from .0007 to .017.
    """
    scene = scene_at(gram, found.rotations, with_scales=with_scales)
    rotations, scales = full_mode_covariance.refined(scene, found.scales, found.covariance, should_stop=should_stop)
    again = refined(
        gram, rotations, scales, with_scales=with_scales, rounds=START_ROUNDS, support=Support(), should_stop=should_stop
    )  # fmt: skip
    return again if again.energy < found.energy else found


def _between(used: NDArray[np.intp], turns: Floats, frames: int) -> Floats:
    """Return turns of all frames, interpolated between those of the frames used."""
    return np.stack([np.interp(np.arange(frames), used, axis) for axis in turns.T], axis=1)


def _seen_from(covariance: ShapeCovariance, first: Floats) -> ShapeCovariance:
    """Return the covariance in the axes of the first camera."""
    return replace(covariance, extent=first @ covariance.extent @ first.T, play=first @ covariance.play @ first.T)


def _told(estimate: CameraEstimate, rotations: Floats, before: Floats) -> CameraEstimate:
    """Return the estimate with new rotations, the first of them the identity, and a sentence about it."""
    rotations = rotations @ rotations[0].T
    turn = float(np.degrees(angles_between(rotations, before).mean()))
    sentence = f"Then refined together with the covariance of the shapes; rotations moved by {turn:.2f}° on average."
    known = estimate.reasons.get("rotations", "")
    read_only(rotations)
    return replace(
        estimate, rotations=rotations, reasons={**estimate.reasons, "rotations": f"{known} {sentence}".strip()}
    )

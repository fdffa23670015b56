"""Cameras and shape covariance together: each is refined for the other, by the likelihood of the tracks alone.

Rotations chosen before anything is known of the deformation take part of it for camera motion. With the covariance learned
(`pliant.solver.covariance`) the same likelihood says which rotations make the tracks most probable (`pliant.solver.likelihood`,
without its penalty on rough modes: the random walk is penalty enough), and both are improved in turn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras import CameraEstimate
from pliant.solver.covariance import (
    FLATTEST,
    ITERATIONS,
    NOISE_FLOOR,
    WARM,
    ShapeCovariance,
    begin,
    improve,
    random_walk,
)
from pliant.solver.likelihood import LOWER, Motion, Scene, cameras_of, covariances_of, fit
from pliant.solver.records import Floats, read_only
from pliant.solver.rotation import angles_between, exponential
from scipy.spatial.transform import Rotation

LEARNED_FRAMES = 360
"""Longer sequences are learned from this many of their frames, evenly spread: the cost grows with F³."""

ROUNDS = 2
"""Refinements of the rotations, each followed by one of the covariance."""

STEADY = 0.01
"""Weight of the camera's unsteadiness: less is needed once the covariance is known."""

TURNS = 60
"""L-BFGS iterations of one refinement of the rotations."""


def learn(
    gram: Floats,
    estimate: CameraEstimate,
    shown: NDArray[np.bool_],
    *,
    turning: bool,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[CameraEstimate, ShapeCovariance]:
    """Return the cameras, refined if `turning`, and the shape covariance of all frames.

    Parameters
    ----------
    gram : array, shape (2F, 2F)
        W Wᵀ / P of centred, complete tracks, normalised units.
    estimate : CameraEstimate
        Where to start; its scales and translations are kept.
    shown : array, shape (F,)
        Which frames show enough to learn from; the others are taken to lie between them.
    turning : bool
        False leaves the rotations as they are: given ones, or as the user wished.
    should_stop : callable, optional
        Asked between refinements; once it says True, the best so far is returned.
    """
    frames = len(estimate.rotations)
    places = np.flatnonzero(shown)
    used = places[np.unique(np.linspace(0, len(places) - 1, min(len(places), LEARNED_FRAMES)).round().astype(np.intp))]
    rows = np.stack([2 * used, 2 * used + 1], axis=1).ravel()
    scales = np.repeat(np.asarray(estimate.scales), 2)
    unscaled = (gram / np.outer(scales, scales))[np.ix_(rows, rows)]
    before = np.asarray(estimate.rotations)[used]
    rotations = before
    covariance = improve(
        begin(unscaled, rotations[:, :2]), unscaled, rotations[:, :2], iterations=ITERATIONS, warm=WARM
    )
    for _ in range(ROUNDS if turning else 0):
        if should_stop is not None and should_stop():
            break
        rotations, covariance = _turn(unscaled, rotations, covariance)
        covariance = improve(covariance, unscaled, rotations[:, :2], iterations=15)
    if len(used) < frames:
        covariance = covariance.stretched(used, frames)
    if not turning:
        return estimate, covariance
    turns = Rotation.from_matrix(rotations @ before.transpose(0, 2, 1)).as_rotvec()
    whole = exponential(_between(used, turns, frames)) @ estimate.rotations
    return _told(estimate, whole), _seen_from(covariance, whole[0])


def telling_frames(visible: Floats) -> NDArray[np.bool_]:
    """Return which frames show at least a tenth of what the others show, shape `(F,)`; all if hardly any does."""
    seen = (visible > 0).sum(axis=1)
    telling = np.asarray(seen >= max(3.0, 0.1 * float(np.median(seen[seen > 0]))))
    return telling if telling.sum() >= 3 else np.ones(len(seen), dtype=bool)


def _turn(gram: Floats, rotations: Floats, covariance: ShapeCovariance) -> tuple[Floats, ShapeCovariance]:
    """Return rotations and covariance of higher likelihood."""
    frames = len(rotations)
    scene = Scene(
        gram, rotations, with_scales=False, walk=random_walk(frames), steadiness=STEADY,
        noise_floor=NOISE_FLOOR**0.5, smoothness=0.0,
    )  # fmt: skip
    started = Motion(
        np.zeros((frames, 3)), np.zeros(frames), covariance.modes,
        _lower(covariance.extent), _lower(covariance.play),
        0.5 * np.log([covariance.noise, covariance.drift]),
    )  # fmt: skip
    moved, _ = fit(scene, started, iterations=TURNS, turning=True)
    extent, play, noise, drift = covariances_of(scene, moved)
    play = play + FLATTEST * np.trace(play) / 3 * np.eye(3)
    size = np.trace(play) / 3
    found = replace(
        covariance, extent=extent, play=play / size, modes=moved.modes * np.sqrt(size), drift=drift * size, noise=noise
    )
    return cameras_of(scene, moved)[0], found


def _lower(matrix: Floats) -> Floats:
    """Return the lower triangle of a root, shape `(6,)`."""
    return np.asarray(np.linalg.cholesky(matrix)[LOWER], dtype=np.float64)


def _between(used: NDArray[np.intp], turns: Floats, frames: int) -> Floats:
    """Return turns of all frames, interpolated between those of the frames used."""
    return np.stack([np.interp(np.arange(frames), used, axis) for axis in turns.T], axis=1)


def _seen_from(covariance: ShapeCovariance, first: Floats) -> ShapeCovariance:
    """Return the covariance in the axes of the first camera."""
    return replace(covariance, extent=first @ covariance.extent @ first.T, play=first @ covariance.play @ first.T)


def _told(estimate: CameraEstimate, rotations: Floats) -> CameraEstimate:
    """Return the estimate with new rotations, the first of them the identity, and a sentence about it."""
    rotations = rotations @ rotations[0].T
    turn = float(np.degrees(angles_between(rotations, np.asarray(estimate.rotations)).mean()))
    sentence = f"Then refined together with the covariance of the shapes; rotations moved by {turn:.2f}° on average."
    known = estimate.reasons.get("rotations", "")
    read_only(rotations)
    return replace(
        estimate, rotations=rotations, reasons={**estimate.reasons, "rotations": f"{known} {sentence}".strip()}
    )

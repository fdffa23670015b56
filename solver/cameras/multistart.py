"""Multistart over camera hypotheses: factorizations with several K, refined with one energy and ranked by it.

No single K suits all data: dense surfaces with small motion need K = 1, motion capture 5 to 12, and no K suits a body
that deforms as fast as it rotates. Every K therefore provides a start, and the two best ones a second start with a
smooth camera. All are refined on the manifold with the same energy (`model.marginal_likelihood` with
`model.camera_motion_prior`), which needs no ground truth. Each round of refinement drops the candidates with the highest
energy plus a penalty on implausible depth; the best one of the last round is returned.

Long sequences use every n-th frame; the correction found is interpolated to the frames in between (`carried`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.model.marginal_likelihood import CAMERA_PRIOR_WEIGHT, Motion, Scene, cameras_of, fit, start
from pliant.solver.model.resection import rotations_between
from pliant.solver.model.so3 import exponential, logarithm, nearest
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats
from pliant.solver.tracks.frame_selection import between
from pliant.solver.tracks.noise import white_noise
from scipy.linalg import solveh_banded

CANDIDATES = (1, 2, 3, 5, 8, 12)
"""K of the factorizations."""

MULTISTART_FRAMES = 120
"""Maximum number of frames in the multistart; longer sequences use every n-th frame."""

FIXED_ROTATION_ITERATIONS = 60
"""L-BFGS iterations with the rotations of the factorization fixed."""

MULTISTART_ROUNDS = ((60, 3), (140, 1))
"""L-BFGS iterations of each round, and the number of candidates kept after it."""

SMOOTH_STARTS = 2
"""Number of candidates that get a second start with a smooth camera."""

SMOOTH_START_ITERATIONS, SMOOTH_START_NOISE_STD, SMOOTH_START_PRIOR_WEIGHT = 100, 3e-2, 10.0
"""A smooth-camera start: L-BFGS iterations, noise floor (standard deviation, normalized units) and weight of the
camera-motion prior. Both are so high that deformation hardly counts."""


CLOSED_FORM_WEIGHT = 1e-3
"""λ1 of the temporal closed form."""

WHITE_NOISE_STD = 0.03
"""White noise, standard deviation in normalized units, at which the camera-motion prior has half its weight. Points
of a surface move together, but their noise is independent: with noise of .09 on a head, cameras are off by 14° at
full weight."""

MAX_RMS_DEPTH = 1.0
"""Root mean square depth, normalized units, above which depth is penalised in the ranking."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Cameras with their energy and parameters."""

    basis_size: int
    """K of the factorization it started from."""
    smooth_start: bool
    scene: Scene
    motion: Motion
    energy: float

    @property
    def cameras(self) -> tuple[Floats, Floats]:
        """Rotations and scales."""
        return cameras_of(self.scene, self.motion)


def with_fixed_rotations(
    gram: Floats,
    rotations: Floats,
    basis_size: int,
    *,
    smooth_start: bool,
    ordered: bool,
    should_stop: ShouldStop,
) -> Candidate:
    """Return cameras, such as those of a factorization, and their energy with the rotations fixed and every scale 1."""
    scene = Scene.of(gram, rotations, with_scales=False, prior_weight=scaled_prior_weight(gram), ordered=ordered)
    motion, energy = fit(
        scene,
        start(scene, np.ones(len(rotations))),
        iterations=FIXED_ROTATION_ITERATIONS,
        turning=False,
        should_stop=should_stop,
    )
    return Candidate(basis_size, smooth_start, scene, motion, energy)


def run_multistart(
    gram: Floats, entries: list[Candidate], *, ordered: bool, should_stop: ShouldStop
) -> tuple[Candidate, list[Candidate]]:
    """Return the best candidate, refined, and all candidates after the first round.

    Parameters
    ----------
    gram : shape (2F, 2F)
        W Wᵀ / P of the completed tracks at the frames used.
    entries : list of Candidate
        From `with_fixed_rotations`; at least one.
    ordered : bool
        False omits smooth starts and the penalty on depth, whose closed form is smooth in time.
    should_stop : callable
        Called before every refinement and after each of its iterations; once it returns True, the best so far is returned.
    """

    def rating(candidate: Candidate) -> float:
        return _rating(gram, candidate) if ordered else candidate.energy

    best = sorted(entries, key=rating)
    running = best + [smooth_start(gram, each, should_stop=should_stop) for each in best[: SMOOTH_STARTS * ordered]]
    first: list[Candidate] = []
    for iterations, left in MULTISTART_ROUNDS:
        finished: list[Candidate] = []
        for candidate in running:
            stopped = should_stop()
            finished.append(candidate if stopped else refined(candidate, iterations, should_stop=should_stop))
        first = first or finished
        running = sorted(finished, key=rating)[:left]
    return running[0], first


def _fixed_energy(gram: Floats, rotations: Floats, should_stop: ShouldStop) -> float:
    return with_fixed_rotations(gram, rotations, 0, smooth_start=True, ordered=True, should_stop=should_stop).energy


def refined(candidate: Candidate, iterations: int, *, should_stop: ShouldStop = never) -> Candidate:
    """Return the candidate after `iterations` L-BFGS iterations with free rotations."""
    motion, energy = fit(
        candidate.scene, candidate.motion, iterations=iterations, turning=True, should_stop=should_stop
    )
    return Candidate(candidate.basis_size, candidate.smooth_start, candidate.scene, motion, energy)


def smooth_start(gram: Floats, candidate: Candidate, *, should_stop: ShouldStop) -> Candidate:
    """Return a candidate with smooth camera motion near the given one.

    The factorization of a body that deforms as fast as it rotates gives jittering cameras near a local minimum of the
    energy. A fit with a high noise floor and a strong camera-motion prior finds the common rotation instead.
    """
    rotations, scales = candidate.cameras
    calm = Scene.of(
        gram,
        rotations,
        with_scales=False,
        prior_weight=SMOOTH_START_PRIOR_WEIGHT,
        noise_std_floor=SMOOTH_START_NOISE_STD,
    )
    motion, _ = fit(
        calm, start(calm, scales), iterations=SMOOTH_START_ITERATIONS, turning=True, should_stop=should_stop
    )
    turned, _ = cameras_of(calm, motion)
    return with_fixed_rotations(
        gram, turned, candidate.basis_size, smooth_start=True, ordered=True, should_stop=should_stop
    )


def carried(rotations: Floats, best: Floats, used: NDArray[np.intp]) -> Floats:
    """Return rotations of all frames, with the correction found at the frames used interpolated in between.

    Corrections are rotations of the world axes, so a rotation of the whole world needs no interpolation.

    Parameters
    ----------
    rotations : shape (F, 3, 3)
        Cameras of all frames, from the factorization.
    best : shape (F', 3, 3)
        Cameras of the frames used, refined.
    used : array of int
        The frames used.
    """
    turns = np.swapaxes(rotations[used], 1, 2) @ best
    common = nearest(turns.sum(axis=0))
    corrections = logarithm(turns @ common.T)
    blended = between(used, corrections, len(rotations))
    return np.asarray(rotations @ exponential(blended) @ common)


def continued(
    gram: Floats, rotations: Floats, best: Floats, used: NDArray[np.intp], *, should_stop: ShouldStop = never
) -> Floats:
    """Return rotations of all frames of a film: `carried`, or interpolated between the frames used, whichever is more probable.

    Once the cameras have left those they began from, the corrections are large, and frames in between inherit the jitter or
    the wrong pose signs of the beginning. Interpolation loses fast motion instead. With every frame used, both are `best`.

    Parameters
    ----------
    gram : shape (2F, 2F)
        W Wᵀ / P of the completed tracks.
    rotations : shape (F, 3, 3)
        Cameras of all frames that the search began from.
    best : shape (F', 3, 3)
        Cameras of the frames used, refined.
    used : array of int
        The frames used.
    should_stop : callable, optional
        Called after each iteration; once it returns True, the cameras so far are compared.
    """
    by_corrections = carried(rotations, best, used)
    if len(used) == len(rotations) or not np.isfinite(by_corrections).all():
        return by_corrections
    both = by_corrections, rotations_between(used, best, len(rotations))
    return min(both, key=lambda each: _fixed_energy(gram, each, should_stop))


def scaled_prior_weight(gram: Floats) -> float:
    """Return the weight of the camera-motion prior, reduced where white noise is strong."""
    return CAMERA_PRIOR_WEIGHT / (1 + white_noise(gram) / WHITE_NOISE_STD**2)


def _rating(gram: Floats, candidate: Candidate) -> float:
    """Return the energy plus a penalty if the closed form is deeper than the image is wide: its rotations are then too small."""
    return candidate.energy + max(0.0, float(np.log(max(depth(gram, candidate.cameras[0]), 1e-12) / MAX_RMS_DEPTH**2)))


def depth(gram: Floats, rotations: Floats) -> float:
    """Return the mean squared depth of the temporal closed form (Dai, Deng, He 2017, eq. 5), normalized units squared.

    S = (ΠᵀΠ + λ1 HᵀH)⁻¹ Πᵀ W, so S Sᵀ / P follows from the Gram matrix by a block-tridiagonal solve, without the shapes.
    """
    frames = len(rotations)
    projections = rotations[:, :2]
    right = np.zeros((frames, 3, frames, 2))
    each = np.arange(frames)
    right[each, :, each] = np.swapaxes(projections, 1, 2)
    solved = solveh_banded(_normal_bands(projections), right.reshape(3 * frames, 2 * frames), lower=True)
    along = np.einsum("fi,fim->fm", rotations[:, 2], solved.reshape(frames, 3, -1))
    return float(((along @ gram) * along).sum()) / frames


def _normal_bands(projections: Floats) -> Floats:
    """Return ΠᵀΠ + λ1 HᵀH in LAPACK's lower banded form, shape `(4, 3F)`."""
    frames = len(projections)
    bands = np.zeros((4, 3 * frames))
    ends = np.full(frames, 2.0)
    ends[[0, -1]] = 1.0
    blocks = np.einsum("fci,fcj->fij", projections, projections)
    blocks += (CLOSED_FORM_WEIGHT * ends + 1e-9)[:, None, None] * np.eye(3)
    for below in range(3):
        for column in range(3 - below):
            bands[below, column::3] = blocks[:, column + below, column]
    bands[3, :-3] = -CLOSED_FORM_WEIGHT
    return bands

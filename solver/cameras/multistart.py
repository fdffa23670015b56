"""Which cameras? Factorizations with several K, refined and judged by one number that needs no ground truth.

No single K serves: dense surfaces that move little want K = 1, mocap 5 to 12, and a body that deforms as fast as it turns none of
them. So every K gives a start, the two most probable ones also a second, steadied one, and all are refined on one energy
(`model.marginal_likelihood` with `model.camera_motion_prior`): variable projection with a log-determinant against flattening, on
the manifold. They race, the slower ones drop out early, and the lowest energy wins. From most starts it is the same minimum.

Long sequences race on every n-th frame; what the race changed is carried to the frames between, so that the time hardly grows with F.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pliant.solver.cameras.factorization import Upgrade
from pliant.solver.model.marginal_likelihood import STEADINESS, Motion, Scene, cameras_of, fit, start
from pliant.solver.model.so3 import exponential, logarithm, nearest
from pliant.solver.records import Floats
from pliant.solver.tracks.noise import white_noise
from scipy.linalg import solveh_banded

CANDIDATES = (1, 2, 3, 5, 8, 12)
"""K tried."""

RACE_FRAMES = 120
"""Longer sequences race on every n-th frame."""

HELD_ITERATIONS = 60
"""L-BFGS iterations with the rotations of the factorization."""

HEATS = ((60, 3), (140, 1))
"""Iterations of every heat, and how many candidates are left after it."""

STEADIED = 2
"""Candidates that also start steadied."""

STEADIED_ITERATIONS, STEADIED_NOISE, STEADIED_WEIGHT = 100, 3e-2, 10.0
"""A steadied start: so much noise and so heavy a camera that only what a steady camera explains is explained."""


CLOSED_FORM_WEIGHT = 1e-3
"""λ1 of the temporal closed form."""

WHITE = 0.03
"""White noise, normalised units, from which the number of points counts: a surface moves together and its points are worth few
independent ones, but their noise is drawn for each of them. Measured: noise of .09 on an animated head, cameras off by 14° without."""

DEEPEST = 1.0
"""Root mean square depth, normalised units, from which more depth counts against a candidate."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Cameras and what is known about them."""

    basis_size: int
    """K of the factorization that it came from."""
    steadied: bool
    scene: Scene
    motion: Motion
    energy: float

    @property
    def cameras(self) -> tuple[Floats, Floats]:
        """Rotations and scales."""
        return cameras_of(self.scene, self.motion)


def frames_used(count: int) -> slice:
    """Return which frames race: all of a short sequence."""
    return slice(None, None, -(-count // RACE_FRAMES))


def gram_of(gram: Floats, used: slice) -> Floats:
    """Return the Gram matrix of some of the frames."""
    frames = len(gram) // 2
    blocks = gram.reshape(frames, 2, frames, 2)[used][:, :, used]
    return np.ascontiguousarray(blocks).reshape(2 * len(blocks), 2 * len(blocks))


def held(
    gram: Floats,
    upgrade: Upgrade,
    scales: Floats,
    *,
    with_scales: bool,
    should_stop: Callable[[], bool] | None = None,
) -> Candidate:
    """Return a factorization's cameras with the energy they have unturned."""
    return _entered(
        gram, upgrade.rotations, scales, upgrade.basis_size,
        with_scales=with_scales, steadied=False, should_stop=should_stop,
    )  # fmt: skip


def race(
    gram: Floats, entries: list[Candidate], *, should_stop: Callable[[], bool] | None = None
) -> tuple[Candidate, list[Candidate]]:
    """Return the winner, refined, and all that ran in the first heat, refined by that heat.

    Parameters
    ----------
    gram : shape (2F, 2F)
        W Wᵀ / P of the completed tracks, of the frames that race.
    entries : list of Candidate
        From `held`, at least one.
    should_stop : callable, optional
        Asked before every refinement; once it says True, the best so far wins.
    """

    def rating(candidate: Candidate) -> float:
        return _rating(gram, candidate)

    ordered = sorted(entries, key=rating)
    running = ordered + [steadied(gram, each, should_stop=should_stop) for each in ordered[:STEADIED]]
    first: list[Candidate] = []
    for iterations, left in HEATS:
        finished: list[Candidate] = []
        for candidate in running:
            stopped = should_stop is not None and should_stop()
            finished.append(candidate if stopped else refined(candidate, iterations, should_stop=should_stop))
        first = first or finished
        running = sorted(finished, key=rating)[:left]
    return running[0], first


def refined(candidate: Candidate, iterations: int, *, should_stop: Callable[[], bool] | None = None) -> Candidate:
    """Return the candidate after that many iterations with the rotations free."""
    motion, energy = fit(
        candidate.scene, candidate.motion, iterations=iterations, turning=True, should_stop=should_stop
    )
    return Candidate(candidate.basis_size, candidate.steadied, candidate.scene, motion, energy)


def steadied(gram: Floats, candidate: Candidate, *, should_stop: Callable[[], bool] | None = None) -> Candidate:
    """Return the cameras nearest to the candidate's that turn as steadily as one can.

    A factorization of a body that deforms as fast as it turns gives cameras that jitter with it, and a minimum of the energy near
    every one of them. Fitted with noise so large that the deformation hardly counts, a heavy camera finds the turn in common.
    """
    rotations, scales = candidate.cameras
    with_scales = candidate.scene.with_scales
    calm = Scene.of(gram, rotations, with_scales=with_scales, steadiness=STEADIED_WEIGHT, noise_floor=STEADIED_NOISE)
    motion, _ = fit(calm, start(calm, scales), iterations=STEADIED_ITERATIONS, turning=True, should_stop=should_stop)
    return _entered(
        gram, *cameras_of(calm, motion), candidate.basis_size,
        with_scales=with_scales, steadied=True, should_stop=should_stop,
    )  # fmt: skip


def carried(rotations: Floats, winner: Floats, used: slice) -> Floats:
    """Return rotations of all frames whose correction is the winner's at the frames used and blends in between.

    Corrections are those of the world's axes, so that a world turned as a whole is none.

    Parameters
    ----------
    rotations : shape (F, 3, 3)
        Cameras of all frames, from the factorization.
    winner : shape (F', 3, 3)
        Cameras of the frames used, refined.
    used : slice
        Which frames they are.
    """
    between = np.swapaxes(rotations[used], 1, 2) @ winner
    common = nearest(between.sum(axis=0))
    corrections = logarithm(between @ common.T)
    frames = np.arange(len(rotations))
    blended = np.stack([np.interp(frames, frames[used], corrections[:, axis]) for axis in range(3)], axis=1)
    return np.asarray(rotations @ exponential(blended) @ common)


def _entered(
    gram: Floats,
    rotations: Floats,
    scales: Floats,
    basis_size: int,
    *,
    with_scales: bool,
    steadied: bool,
    should_stop: Callable[[], bool] | None,
) -> Candidate:
    scene = Scene.of(gram, rotations, with_scales=with_scales, steadiness=binding(gram))
    motion, energy = fit(
        scene, start(scene, scales), iterations=HELD_ITERATIONS, turning=False, should_stop=should_stop
    )
    return Candidate(basis_size, steadied, scene, motion, energy)


def binding(gram: Floats) -> float:
    """Return the weight of the camera's unsteadiness: less where white noise is strong."""
    return STEADINESS / (1 + white_noise(gram) / WHITE**2)


def _rating(gram: Floats, candidate: Candidate) -> float:
    """Return the energy, raised where the closed form comes out deeper than the image is wide: turns that are far too small."""
    return candidate.energy + max(0.0, float(np.log(max(depth(gram, candidate.cameras[0]), 1e-12) / DEEPEST**2)))


def depth(gram: Floats, rotations: Floats) -> float:
    """Return the mean squared depth of the temporal closed form (Dai, Deng, He 2017, eq. 5), normalised units.

    S = (ΠᵀΠ + λ1 HᵀH)⁻¹ Πᵀ W, so that S Sᵀ / P follows from the Gram matrix; a block-tridiagonal solve, no shapes.
    """
    frames = len(rotations)
    pairs = rotations[:, :2]
    right = np.zeros((frames, 3, frames, 2))
    each = np.arange(frames)
    right[each, :, each] = np.swapaxes(pairs, 1, 2)
    solved = solveh_banded(_normal_bands(pairs), right.reshape(3 * frames, 2 * frames), lower=True)
    along = np.einsum("fi,fim->fm", rotations[:, 2], solved.reshape(frames, 3, -1))
    return float(((along @ gram) * along).sum()) / frames


def _normal_bands(pairs: Floats) -> Floats:
    """Return ΠᵀΠ + λ1 HᵀH in LAPACK's lower banded form, shape `(4, 3F)`."""
    frames = len(pairs)
    bands = np.zeros((4, 3 * frames))
    ends = np.full(frames, 2.0)
    ends[[0, -1]] = 1.0
    blocks = np.einsum("fci,fcj->fij", pairs, pairs)
    blocks += (CLOSED_FORM_WEIGHT * ends + 1e-9)[:, None, None] * np.eye(3)
    for below in range(3):
        for column in range(3 - below):
            bands[below, column::3] = blocks[:, column + below, column]
    bands[3, :-3] = -CLOSED_FORM_WEIGHT
    return bands

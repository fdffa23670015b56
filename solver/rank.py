"""Which K? Factorizations with several K, judged by quantities that need no ground truth.

Two questions are asked of each candidate's cameras, both answered from the Gram matrix. How probable are the tracks, whatever
the shapes (`pliant.solver.likelihood`)? And how rough is the motion that they leave, relative to the depth that they give: with S
the temporal closed form (Dai, Deng, He 2017, eq. 5), log mean ‖S_f − S_{f−1}‖² − log mean z², z the depth. Roughness alone
prefers cameras that absorb deformation of a nearly rigid object, probability alone is blind to jitter that a flexible one
absorbs; wrong cameras raise at least one of them. Both are logarithms of variances, so they are added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver.likelihood import Motion, Scene, fit, start
from pliant.solver.metric_upgrade import Upgrade
from pliant.solver.records import Floats
from scipy.linalg import solveh_banded

CANDIDATES = (1, 2, 3, 5, 8, 12)
"""K tried."""

SCORED_FRAMES = 120
"""Longer sequences are judged on every n-th frame."""

CLOSED_FORM_WEIGHT = 1e-3
"""λ1 of the temporal closed form."""

DEEPEST = 1.0
"""Mean squared depth, normalised units, from which more depth counts against a candidate: noisy cameras explode in depth."""

FIT_ITERATIONS = 60
"""L-BFGS iterations of a candidate's likelihood; the order of the candidates settles long before convergence."""


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """A candidate and what is known about it."""

    upgrade: Upgrade
    scene: Scene
    """On the frames that were used."""
    motion: Motion
    """Fitted density with the candidate's rotations."""
    energy: float
    roughness: float

    @property
    def score(self) -> float:
        """Smaller is better."""
        return self.energy + 0.5 * self.roughness


def frames_used(count: int) -> slice:
    """Return which frames judge a sequence: all of a short one."""
    return slice(None, None, -(-count // SCORED_FRAMES))


def score(gram: Floats, candidate: Upgrade, scales: Floats, *, with_scales: bool) -> Scored:
    """Return the candidate with its energy and roughness.

    Parameters
    ----------
    gram : shape (2F, 2F)
        W Wᵀ / P of the completed tracks.
    candidate : Upgrade
        Cameras of all frames.
    scales : shape (F,)
        The candidate's scales, all 1 for plain orthography.
    with_scales : bool
        Whether the scales are fitted.
    """
    used = frames_used(len(scales))
    part = gram_of(gram, used)
    scene = Scene.of(part, candidate.rotations[used], with_scales=with_scales)
    motion, energy = fit(scene, start(scene, scales[used]), iterations=FIT_ITERATIONS, turning=False)
    fitted = np.exp(motion.log_scales - motion.log_scales.mean()) if with_scales else np.ones(len(part) // 2)
    return Scored(candidate, scene, motion, energy, roughness(part, candidate.rotations[used], fitted))


def gram_of(gram: Floats, used: slice) -> Floats:
    """Return the Gram matrix of some of the frames."""
    frames = len(gram) // 2
    blocks = gram.reshape(frames, 2, frames, 2)[used][:, :, used]
    return np.ascontiguousarray(blocks).reshape(2 * len(blocks), 2 * len(blocks))


def roughness(gram: Floats, rotations: Floats, scales: Floats) -> float:
    """Return the logarithm of the temporal closed form's mean squared step over its mean squared depth.

    S = (ΠᵀΠ + λ1 HᵀH)⁻¹ Πᵀ W, so that S Sᵀ / P follows from the Gram matrix; a block-tridiagonal solve, no shapes.
    """
    frames = len(rotations)
    pairs = rotations[:, :2] * scales[:, None, None]
    right = np.zeros((3 * frames, 2 * frames))
    for frame, pair in enumerate(pairs):
        right[3 * frame : 3 * frame + 3, 2 * frame : 2 * frame + 2] = pair.T
    solved = solveh_banded(_normal_bands(pairs), right, lower=True)
    half = solved @ gram
    blocks, others = solved.reshape(frames, 3, -1), half.reshape(frames, 3, -1)
    own = np.einsum("fim,fjm->fij", others, blocks)
    next_one = np.einsum("fim,fim->", others[1:], blocks[:-1])
    squares = np.trace(own, axis1=1, axis2=2)
    step = (squares[1:].sum() + squares[:-1].sum() - 2 * next_one) / (frames - 1)
    depth = np.einsum("fi,fij,fj->f", rotations[:, 2], own, rotations[:, 2]).mean()
    tiny = np.finfo(float).tiny
    plausible = min(depth, DEEPEST**2 / max(depth, tiny))
    return float(np.log(max(step, tiny)) - np.log(max(plausible, tiny)))


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

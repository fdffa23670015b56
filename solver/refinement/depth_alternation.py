"""Alternation under perspective between depths, covariance, cameras and κ, and new cameras from the corrected tracks.

Cameras estimated under orthography are off by degrees where perspective is strong, and with little noise the likelihood cannot turn them
back, since every mode would have to change as well. A factorization of the corrected tracks is independent of these cameras, and most of
the perspective is gone. The alternation continues from the most probable factorization while the evidence rises.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.aimed import Aimed, towards
from pliant.solver.cameras.factorization import upgrades
from pliant.solver.cameras.multistart import CANDIDATES
from pliant.solver.cameras.perspective import Perspective, corrected, depth_map, depths_of
from pliant.solver.model.marginal_likelihood import UNLIKELY
from pliant.solver.model.so3 import MIRROR, nearest
from pliant.solver.pulse import never
from pliant.solver.records import Floats
from pliant.solver.refinement.focal_length import refine_with_focal
from pliant.solver.refinement.learned import Learned, Refinement
from pliant.solver.refinement.starts import START_FRAMES
from pliant.solver.tracks.frame_selection import evenly_spread
from pliant.solver.tracks.matrix import centred, columns, gram_of

ALTERNATION_ROUNDS = 3
"""Updates of depths, covariance, cameras and κ each time that cameras were found or refined."""

ALTERNATION_EM_ROUNDS = 60
"""EM rounds per update."""


def alternate(
    view: Perspective,
    found: Learned,
    used: NDArray[np.intp],
    how: Refinement,
    *,
    rounds: int = ALTERNATION_ROUNDS,
) -> tuple[Learned, Perspective]:
    """Return cameras, covariance and κ after rounds of alternation, which end before a round whose depths diverge.

    If that is the first one and the depths of `found` diverge, too, its energy is set to `UNLIKELY`.

    Parameters
    ----------
    view : Perspective
        Starting κ, and the sample at all frames.
    found : Learned
        Starting cameras and covariance, at the frames used.
    used : array of int, shape (F',)
        Indices of the frames used.
    how : Refinement
        What is refined; scales are if any differs from 1.
    rounds : int
        Maximum number of rounds.
    """
    views, start = view.learning_sample[used], found
    for _ in range(rounds):
        if how.should_stop():
            break
        try:
            moved = _relearned(views, view.inverse_focal, found, how)
        except np.linalg.LinAlgError:
            break
        moved, inverse_focal = refine_with_focal(
            views, moved, view.inverse_focal, free=view.given is None, turning=how.turning
        )
        if moved.energy >= UNLIKELY or not _ahead(views, moved, inverse_focal):
            break
        found, view = moved, replace(view, inverse_focal=inverse_focal)
    if found is start and found.energy < UNLIKELY and not _ahead(views, found, view.inverse_focal):
        found = replace(found, energy=UNLIKELY)
    return found, view


def _ahead(views: Floats, found: Learned, inverse_focal: float) -> bool:
    """Whether every point lies in front of its camera; some do not where the fixed-point steps of `depths_of` diverge."""
    try:
        depths = depths_of(depth_map(found.rotations, found.scales, found.covariance), views, inverse_focal)
    except np.linalg.LinAlgError:
        return False
    return bool((1 + inverse_focal * depths).min() > 0)


def refactorize(
    scales: Floats,
    view: Perspective,
    found: Learned,
    used: NDArray[np.intp],
    how: Refinement,
) -> Floats | None:
    """Return the rotations `(F, 3, 3)` of the most probable factorization of the corrected tracks; None if `found` is more probable.

    Parameters
    ----------
    scales : array, shape (F,)
        Scales by which the corrected tracks are divided.
    view : Perspective
        κ, and the sample and the depth map of all frames.
    found : Learned
        Cameras and covariance, at the frames used. The factorizations are aligned to their world axes and sign of depth.
    used : array of int, shape (F',)
        Indices of the frames used.
    how : Refinement
        What the comparison refines; must turn.
    """
    places = evenly_spread(len(used), START_FRAMES)
    some = used[places]
    part = replace(
        found, rotations=found.rotations[places], scales=found.scales[places], energy=np.inf,
        covariance=replace(found.covariance, modes=found.covariance.modes[places]),
    )  # fmt: skip

    def energy(start: Learned) -> float:
        moved, _ = alternate(view, start, some, replace(how, should_stop=never), rounds=1)
        return moved.energy

    turns = towards(view.learning_sample.mean(axis=1), view.inverse_focal)
    rows = columns(_turned(view, turns) / scales[:, None, None])
    gram = gram_of(rows)
    limit = min(len(gram) // 3, view.learning_sample.shape[1] // 3)
    best, lowest = None, energy(part)
    for each in upgrades(gram, [size for size in CANDIDATES if size <= limit]):
        if how.should_stop():
            break
        rotations = turns.transpose(0, 2, 1) @ aligned(each.rotations, turns[used] @ found.rotations, used)
        reached = energy(replace(part, rotations=rotations[some]))
        if reached < lowest:
            best, lowest = rotations, reached
    return best


def _turned(view: Perspective, turns: Floats) -> Floats:
    """Return the corrected and centred tracks of the sample, `(F, S, 2)`, seen by turned cameras."""
    depths = depths_of(view.depth, view.learning_sample, view.inverse_focal)
    images = centred(corrected(view.learning_sample, depths, view.inverse_focal))
    depths -= depths.mean(axis=1, keepdims=True)
    return np.asarray(images @ turns[:, :2, :2].transpose(0, 2, 1) + depths[..., None] * turns[:, None, :2, 2])


def aligned(rotations: Floats, like: Floats, used: NDArray[np.intp]) -> Floats:
    """Return rotations `(F, 3, 3)` in the world axes and with the sign of depth that bring the frames used closest to `like`."""
    choices = []
    for each in (rotations, MIRROR @ rotations @ MIRROR):
        moved = each @ nearest((each[used].transpose(0, 2, 1) @ like).sum(axis=0)[None])[0]
        choices.append((float(np.square(moved[used] - like).sum()), moved))
    return np.asarray(min(choices, key=lambda choice: choice[0])[1])


def _relearned(views: Floats, inverse_focal: float, found: Learned, how: Refinement) -> Learned:
    """Return `found` with the covariance of the tracks corrected with its depths; `views` has shape `(F', S, 2)`."""
    aimed = Aimed.of(views, inverse_focal) if how.turning else Aimed.unturned(views)
    rotations = aimed.turned(found.rotations)
    depths = depths_of(aimed.depth_map(rotations, found.scales, found.covariance), aimed.views, inverse_focal)
    flat = corrected(aimed.views, depths, inverse_focal)
    again = how.anneal(flat, rotations, found.scales, iterations=ALTERNATION_EM_ROUNDS)
    return replace(found, covariance=again.covariance)

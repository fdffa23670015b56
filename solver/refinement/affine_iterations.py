"""Cameras under perspective by affine iterations: a start that does not depend on cameras found under orthography.

The tracks are factorized, corrected with the depths found, and factorized again (Christy and Horaud, "Euclidean shape and motion from
multiple perspective views by affine iterations", IEEE PAMI 18(11), 1996). For an object that deforms, the factorization has rank 3K, and
depths are posterior means (`cameras.perspective`). Where deformation is large, cameras found under orthography can be off by 10°, and
refinement hardly turns them; a few of these iterations lead to within 2° to 6° of the true ones from most K.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver.cameras.factorization import upgrade
from pliant.solver.cameras.perspective import Perspective, corrected, depth_map, depths_of
from pliant.solver.records import Floats
from pliant.solver.refinement.depth_alternation import aligned
from pliant.solver.refinement.focal_length import (
    INVERSE_FOCALS,
    SEARCH_EM_ROUNDS,
    SEARCH_ITERATIONS,
    compared_frames,
    refine_with_focal,
)
from pliant.solver.refinement.learned import Learned, Refinement
from pliant.solver.tracks.matrix import centred, columns, gram_of

SIZES = (2, 5)
"""K of the factorizations. A rigid object (K = 1) deforms too little to need them; with 3 and 8 as well, errors are about the same."""

ITERATIONS = 3
"""Corrections at each κ. Measured on a tearing sheet, an arm and a stick figure (`benchmarks.accuracy.kinds`): rotations
stop improving after one to four."""

FIRST_INVERSE_FOCAL = INVERSE_FOCALS[len(INVERSE_FOCALS) // 2]
"""κ, inverse RMS radii, at which every K and both signs of depth are tried; larger and smaller ones follow from the best."""


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """Cameras from affine iterations at one κ, their covariance, and how probable the tracks are with both."""

    size: int
    inverse_focal: float
    found: Learned
    nll: float


def affine_iterations(
    views: Floats,
    rotations: Floats,
    scales: Floats,
    view: Perspective,
    how: Refinement,
) -> tuple[Learned, float] | None:
    """Return cameras, covariance and κ of the most probable iterations; None if the search for κ from `rotations` found more probable ones.

    Parameters
    ----------
    views : array, shape (F, S, 2)
        Complete tracks of sampled points, relative to the principal point, normalized units.
    rotations : array, shape (F, 3, 3)
        Other cameras, whose world axes and sign of depth are adopted where κ > 0.
    scales : array, shape (F,)
        Scales, which are kept.
    view : Perspective
        Result of the search: its κ with `candidates`, given κ, and signs of κ to try.
    how : Refinement
        How covariances are learned, and when to stop.
    """
    used = compared_frames(views)
    part = _Iterations(views[used], rotations[used], scales[used], how)
    first = FIRST_INVERSE_FOCAL if view.given is None else view.given
    trials: list[_Trial] = []
    for size in SIZES:
        if how.should_stop() or 3 * size > min(2 * len(used), views.shape[1]):
            break
        start = part.factorized(size)
        trials += [part.iterated(size, sign * first, start) for sign in view.signs]
    if not trials:
        return None
    best = min(trials, key=lambda trial: trial.nll)
    if view.given is None:
        best = _continued(part, best)
    if best.nll >= min(
        (each.nll for each in view.candidates if each.inverse_focal == view.inverse_focal), default=np.inf
    ):
        return None
    every = _Iterations(views, rotations, scales, how)
    return every.iterated(best.size, best.inverse_focal, every.factorized(best.size)).found, best.inverse_focal


def _continued(part: _Iterations, best: _Trial) -> _Trial:
    """Return the best of larger values of κ, one by one while the likelihood rises, or of smaller ones if it does not rise at all."""
    middle = INVERSE_FOCALS.index(abs(best.inverse_focal))
    for sizes in (INVERSE_FOCALS[middle + 1 :], INVERSE_FOCALS[middle - 1 :: -1]):
        start = best
        for size in sizes:
            trial = part.iterated(best.size, float(np.copysign(size, best.inverse_focal)), best.found)
            if trial.nll >= best.nll:
                break
            best = trial
        if best is not start:
            break
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Iterations:
    """Tracks, and the cameras that others are aligned to."""

    views: Floats
    rotations: Floats
    scales: Floats
    how: Refinement

    def factorized(self, size: int) -> Learned:
        """Return cameras and covariance from the uncorrected tracks."""
        return self._factorized(self.views, size, self.rotations)

    def iterated(self, size: int, inverse_focal: float, start: Learned) -> _Trial:
        """Return the trial after `ITERATIONS` corrections, or as many as do not diverge."""
        found = start
        for _ in range(ITERATIONS):
            try:
                depths = depths_of(
                    depth_map(found.rotations, found.scales, found.covariance), self.views, inverse_focal
                )
                found = self._factorized(corrected(self.views, depths, inverse_focal), size, found.rotations)
            except np.linalg.LinAlgError:
                break
        return self._rated(size, inverse_focal, found)

    def _rated(self, size: int, inverse_focal: float, found: Learned) -> _Trial:
        try:
            refined, _ = refine_with_focal(
                self.views, found, inverse_focal, free=False, turning=True, iterations=SEARCH_ITERATIONS
            )
        except np.linalg.LinAlgError:  # the depths diverge
            return _Trial(size, inverse_focal, found, np.inf)
        return _Trial(size, inverse_focal, found, refined.energy)

    def _factorized(self, images: Floats, size: int, like: Floats) -> Learned:
        rows = columns(centred(images)) / np.repeat(self.scales, 2)[:, None]
        rotations = upgrade(gram_of(rows), size).rotations
        turned = aligned(rotations, like, np.arange(len(images)))
        return self.how.anneal(images, turned, self.scales, iterations=SEARCH_EM_ROUNDS)

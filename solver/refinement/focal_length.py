"""Focal length and sign of depth by the marginal likelihood of tracks corrected for perspective.

For each κ = 1/φ compared, the tracks are corrected with posterior depths, and cameras and covariance of the shapes are refined
(`cameras.perspective`, `model.marginal_likelihood`). Uncorrected perspective looks like deformation and needs modes; a correction with the
wrong κ or the wrong sign of depth needs more of them. The likelihood of the corrected tracks, including the density of the correction,
therefore has its maximum near the true κ; κ < 0 stands for mirrored depths, and κ = 0 is orthography. Every κ continues from cameras and
covariance of a neighbour, since the likelihoods of separate optima differ by more than perspective adds to noisy tracks.

The comparison needs few frames. Its κ is then refined on all frames, jointly with cameras and modes. Estimated cameras are turned towards
the object (`cameras.aimed`). Between two updates of the depths z, the corrected tracks are linearized in the change δ of κ, so their Gram
matrix is G₀ + δ G₁ + δ² G₂, and L-BFGS treats κ as one more parameter with the gradient

    ∂E/∂κ = tr M⁻¹(G₁ + 2δ G₂) / 2F + d′ − 2 mean z/(1 + κz),

where d′ is the derivative of the density of the turn. Known rotations are not turned: the corrected tracks v + κ v z are then linear in κ.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.aimed import Aimed, towards
from pliant.solver.cameras.perspective import (
    Candidate,
    Perspective,
    corrected,
    density,
    depths_of,
)
from pliant.solver.model.image_density import factor_of
from pliant.solver.model.lbfgs import minimize
from pliant.solver.model.marginal_likelihood import CAMERA_PRIOR_WEIGHT, UNLIKELY, Motion, energy_with_inverse
from pliant.solver.model.resection import MIN_RELATIVE_DISTANCE
from pliant.solver.pulse import never
from pliant.solver.records import Floats
from pliant.solver.refinement.learned import Learned, Refinement, motion_of, moved_to, scene_at, to_all_frames
from pliant.solver.tracks.frame_selection import evenly_spread
from pliant.solver.tracks.matrix import centred, columns

INVERSE_FOCALS = (0.02, 0.035, 0.06, 0.1, 0.16, 0.25, 0.38)
"""Values of κ compared, in inverse RMS radii of the tracks, each with both signs. At .02 the correction is 1 % to 2 % of a position; at
.38 an object fills 80° of the view."""

SEARCH_FRAMES = 32
"""Frames on which values of κ are compared, evenly spread; fewer if there are fewer than two points per frame."""

SEARCH_EM_ROUNDS, SEARCH_ITERATIONS = 40, 20
"""EM rounds from scratch for κ = 0, and L-BFGS iterations of each refinement. With 60 iterations, noisy orthographic tracks gain up to
.020."""

MAX_POLISHES = 3
"""Maximum number of further values of κ, between the best of the grid and its neighbours."""

MIN_PERSPECTIVE_GAIN = 0.02
"""Gain in log likelihood, per point and frame, required of perspective over orthography and of one sign of depth over the other.
Orthographic tracks of a dance gain .017 or .022, depending on the frames compared, noisy ones of a face up to .017; five sequences with all
errors, seen from ten half-sizes, gain .022 to .121."""

MIN_TOTAL_GAIN = 10.0
"""Gain in log likelihood of all observations together required of perspective: few observations are weak evidence. Kass and Raftery
(1995), Bayes factors, call 5 very strong."""

UNCLEAR_GAINS = (MIN_PERSPECTIVE_GAIN / 4, 1.5 * MIN_PERSPECTIVE_GAIN)
"""Gains, per point and frame, with which neither orthography nor perspective is clearly the better model. Of 57 solves of
`benchmarks.accuracy.kinds`, on which the lower limit was chosen, 12 without an isometric surface have such gains, and errors of .098 to
.57; so have two films of a bending body, with .23 and .27. The upper limit lies below the film of `pliant demo`, which is solved well with
a gain of .046. Of 51 good solves of `benchmarks.trust`, one has such a gain, with an error of .008."""

COMPARED_RATIO = 1.6
"""Factor between a given focal length and the longer and shorter ones that it is compared with."""

UPDATE_ITERATIONS = 60
"""L-BFGS iterations of κ, cameras and modes between two updates of the depths."""


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A value of κ with the cameras and the covariance refined for it."""

    inverse_focal: float
    nll: float
    found: Learned


def search(
    views: Floats,
    rotations: Floats,
    scales: Floats,
    view: Perspective,
    how: Refinement,
) -> tuple[Perspective, Learned]:
    """Return the perspective with the best κ, 0 unless the tracks need perspective, and cameras and covariance refined with it.

    Parameters
    ----------
    views : array, shape (F, S, 2)
        Complete tracks of sampled points, relative to the principal point, normalized units.
    rotations : array, shape (F, 3, 3)
        Cameras found under orthography.
    scales : array, shape (F,)
        Their scales.
    view : Perspective
        Given parameters. The `inverse_focal` returned has the sign opposite to `signs[0]` if depths must be mirrored.
    how : Refinement
        What is refined; scales are if any differs from 1.
    """
    used = compared_frames(views)
    comparison = _Comparison.of(views[used], rotations[used], scales[used], how)
    for size, sign in _walk(view, comparison.trials):
        if how.should_stop():
            break
        comparison.add(sign * size)
    for _ in range(MAX_POLISHES if view.given is None and _promising(view, comparison.trials) else 0):
        middle = _between(comparison.trials)
        if middle is None or how.should_stop():
            break
        comparison.add(middle)
    if _promising(view, comparison.trials):
        comparison.level()
    view = _decided(view, comparison.trials, len(used), views.shape[1])
    found = comparison.trials[view.inverse_focal if view.inverse_focal in comparison.trials else 0.0].found
    return view, to_all_frames(found, used, rotations)


def compared_frames(views: Floats) -> NDArray[np.intp]:
    """Return the indices of the frames on which values of κ are compared, given tracks `(F, S, 2)`."""
    return evenly_spread(len(views), max(min(SEARCH_FRAMES, len(views), views.shape[1] // 2), 3))


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """Values of κ compared on some frames; each continues from a neighbour."""

    views: Floats
    how: Refinement
    trials: dict[float, _Trial]

    @classmethod
    def of(cls, views: Floats, rotations: Floats, scales: Floats, how: Refinement) -> _Comparison:
        """Learn the covariance for κ = 0 from scratch."""
        comparison = cls(views, how, {})
        flat = _Trial(0.0, np.inf, how.anneal(views, rotations, scales, iterations=SEARCH_EM_ROUNDS))
        comparison.trials[0.0] = comparison._continued(flat, 0.0)
        return comparison

    def add(self, inverse_focal: float) -> None:
        """Add a value of κ, continued from the next smaller one of its sign."""
        nearest = max((each for each in self.trials if 0 <= each / inverse_focal < 1), key=abs)
        self.trials[inverse_focal] = self._continued(self.trials[nearest], inverse_focal)

    def level(self) -> None:
        """Continue every value of κ from both neighbours where that is more probable, so that all are refined equally well."""
        order = sorted(self.trials)
        middle = order.index(0.0)
        inwards = [*pairwise(order[: middle + 1]), *pairwise(order[: middle - 1 if middle else None : -1])]
        outwards = [(target, source) for source, target in reversed(inwards)]
        for source, target in inwards + outwards:
            if self.how.should_stop():
                return
            found = self._continued(self.trials[source], target)
            if found.nll < self.trials[target].nll:
                self.trials[target] = found

    def _continued(self, trial: _Trial, inverse_focal: float) -> _Trial:
        """Return the trial of κ with depths, cameras and covariance refined from those of `trial`."""
        found = trial.found
        if self.how.turning:
            middle = self.views.mean(axis=1)
            turns = towards(middle, inverse_focal).transpose(0, 2, 1) @ towards(middle, trial.inverse_focal)
            found = replace(found, rotations=turns @ found.rotations)
        try:
            found, _ = refine_with_focal(
                self.views, found, inverse_focal, free=False, turning=self.how.turning, iterations=SEARCH_ITERATIONS
            )
        except np.linalg.LinAlgError:  # the depths diverge
            return _Trial(inverse_focal, UNLIKELY, replace(found, energy=UNLIKELY))
        return _Trial(inverse_focal, found.energy, found)


def _walk(view: Perspective, trials: dict[float, _Trial]) -> Iterator[tuple[float, int]]:
    """Yield sizes and signs of κ to compare, given the trials so far.

    A given focal length is compared with two others. Otherwise sizes increase; a sign is dropped once the other is clearly
    better. The search ends if the two smallest sizes gain nothing, or once it has passed the minimum.
    """
    if view.given is not None:
        yield from (
            (view.given * factor, sign) for factor in (1, 1 / COMPARED_RATIO, COMPARED_RATIO) for sign in view.signs
        )
        return
    signs = list(view.signs)
    for index, size in enumerate(INVERSE_FOCALS):
        for sign in signs:
            yield size, sign
        done = [trials[sign * size].nll for sign in signs if sign * size in trials]
        if len(done) < len(signs) or (index == 1 and not _promising(view, trials)):
            return
        if len(signs) == 2 and abs(done[0] - done[1]) > MIN_PERSPECTIVE_GAIN and index > 0:
            signs = [signs[int(np.argmin(done))]]
            done = [min(done)]
        if index > 1 and min(done) > trials[_best(trials)].nll + MIN_PERSPECTIVE_GAIN:
            return


def _promising(view: Perspective, trials: dict[float, _Trial]) -> bool:
    return view.required or trials[_best(trials)].nll < trials[0.0].nll


def _best(trials: dict[float, _Trial]) -> float:
    """Return the most probable κ ≠ 0; 0 if there is none."""
    return min((each for each in trials if each != 0), key=lambda each: trials[each].nll, default=0.0)


def _around(trials: dict[float, _Trial]) -> tuple[Floats, Floats] | None:
    """Return the best κ ≠ 0 with its neighbours, and their negative log likelihoods; None if it is the first or last compared."""
    values = np.array(sorted(trials))
    place = int(np.searchsorted(values, _best(trials)))
    if not 0 < place < len(values) - 1:
        return None
    three = values[place - 1 : place + 2]
    return three, np.array([trials[float(each)].nll for each in three])


def _parabola(three: Floats, nll: Floats) -> tuple[float, float]:
    """Return the minimiser of the parabola through three points (the middle one if concave), and its second derivative."""
    curve, slope, _ = np.polyfit(three - three[1], nll, 2)
    return float(three[1] - slope / (2 * curve)) if curve > 0 else float(three[1]), 2 * float(curve)


def _between(trials: dict[float, _Trial]) -> float | None:
    """Return the κ to compare next: the parabola's minimiser or, near the best κ, a point a third into the wider side."""
    found = _around(trials)
    if found is None:
        return None
    three, nll = found
    best, _ = _parabola(three, nll)
    low, high = three[0] + 0.1 * (three[1] - three[0]), three[2] - 0.1 * (three[2] - three[1])
    best = float(np.clip(best, low, high))
    if abs(best - three[1]) < 0.05 * abs(three[1]):
        wide = three[2] - three[1] > three[1] - three[0]
        best = float(three[1] + (three[2] - three[1] if wide else three[0] - three[1]) / 3)
    return best


def _decided(view: Perspective, trials: dict[float, _Trial], frames: int, points: int) -> Perspective:
    """Return the perspective with the most probable κ, its standard deviation, and whether the sign of depth is known.

    The points of a surface move together, so they count as at most 1/`CAMERA_PRIOR_WEIGHT` independent ones.
    """
    candidates = tuple(Candidate(each, trials[each].nll) for each in sorted(trials))
    if view.given is not None:
        signed = [sign * view.given for sign in view.signs if sign * view.given in trials]
        best = min(signed, key=lambda each: trials[each].nll, default=view.signs[0] * view.given)
    else:
        best = _best(trials)
    if best not in trials or best == 0:  # stopped
        return replace(view, inverse_focal=best, candidates=candidates)
    nll = trials[best].nll
    opposite = min((each.nll for each in candidates if each.inverse_focal * best < 0), default=np.inf)
    sign_known = len(view.signs) == 1 or bool(np.isfinite(opposite) and opposite - nll > MIN_PERSPECTIVE_GAIN)
    needed = trials[0.0].nll - nll > max(MIN_PERSPECTIVE_GAIN, MIN_TOTAL_GAIN / (frames * points)) and sign_known
    if not (needed or view.required or view.given is not None):
        return replace(view, inverse_focal=0.0, candidates=candidates)
    std, found = None, _around(trials)
    if view.given is None and found is not None:
        bend = max(_parabola(*found)[1], 1e-12)
        std = float(1 / np.sqrt(bend * frames * min(points, 1 / CAMERA_PRIOR_WEIGHT)))
    return replace(view, inverse_focal=best, inverse_focal_std=std, candidates=candidates, sign_known=sign_known)


def more_probable(view: Perspective) -> tuple[float, float] | None:
    """Return κ and gain of what is clearly more probable than the given focal length, 0 for orthography; None if nothing is.

    The gain is infinite if the depths diverge with the given focal length.
    """
    if view.given is None:
        return None
    nll = {each.inverse_focal: each.nll for each in view.candidates}
    own = min((nll[each] for each in (view.given, -view.given) if each in nll), default=np.inf)
    best = min(nll, key=lambda each: nll[each], default=0.0)
    if not np.isfinite(own) or own - nll.get(best, np.inf) <= MIN_PERSPECTIVE_GAIN:
        return None
    return best, own - nll[best] if own < UNLIKELY else np.inf


def unclear_perspective(view: Perspective) -> float | None:
    """Return κ of the best perspective compared, if the tracks hardly distinguish it from orthography; None if they do.

    Values of κ below the smallest of the grid, where perspective makes no difference, do not count. Nor does a given focal length or
    camera model, about which the tracks were not asked.
    """
    nll = {each.inverse_focal: each.nll for each in view.candidates if abs(each.inverse_focal) >= INVERSE_FOCALS[0]}
    flat = next((each.nll for each in view.candidates if each.inverse_focal == 0), None)
    if view.given is not None or view.required or flat is None or not nll:
        return None
    best = min(nll, key=lambda each: nll[each])
    return best if UNCLEAR_GAINS[0] < flat - nll[best] < UNCLEAR_GAINS[1] else None


def refine_with_focal(
    views: Floats,
    found: Learned,
    inverse_focal: float,
    *,
    free: bool,
    turning: bool,
    iterations: int = UPDATE_ITERATIONS,
) -> tuple[Learned, float]:
    """Return cameras, covariance and κ of higher likelihood, after one update of the depths.

    Parameters
    ----------
    views : array, shape (F, S, 2)
        Complete tracks relative to the principal point, normalized units.
    found : Learned
        Cameras and covariance to start from; scales that are all 1 are kept.
    inverse_focal : float
        κ to start from.
    free : bool
        False keeps κ.
    turning : bool
        False keeps the rotations.
    iterations : int
        L-BFGS iterations.
    """
    turns = towards(views.mean(axis=1), inverse_focal)
    start = replace(found, rotations=turns @ found.rotations) if turning else found
    energy = CorrectedEnergy(views, inverse_focal, start, turning=turning)
    motion = motion_of(energy.scene, start)
    held = 0 if turning else 3 * len(views)
    given = np.append(motion.flat(), inverse_focal)

    def objective(moving: Floats) -> tuple[float, Floats]:
        value, gradient = energy(np.concatenate([given[:held], moving]))
        gradient[-1] *= free
        return value, gradient[held:]

    moving, value = minimize(objective, given[held:], maxiter=iterations, should_stop=never)
    flat = np.concatenate([given[:held], moving])
    moved = moved_to(energy.scene, start, Motion.unflat(flat[:-1], len(views)), value)
    turns = towards(views.mean(axis=1), float(flat[-1]))
    rotations = turns.transpose(0, 2, 1) @ moved.rotations if turning else found.rotations
    return replace(moved, rotations=rotations), float(flat[-1])


class CorrectedEnergy:
    """E of tracks corrected with fixed depths, as a function of the likelihood's parameters, followed by κ.

    The tracks are linear in the change of κ. With `turning`, they are turned towards the object (`cameras.aimed`), as are the cameras of
    `found`. Rotations that are known are not: they would have to turn with κ. Scales are free if any in `found` differs from 1.
    """

    def __init__(self, views: Floats, inverse_focal: float, found: Learned, *, turning: bool = True) -> None:
        count = views.shape[1]
        aimed, slope, self.density_slope = Aimed.unturned(views), np.zeros_like(views), 0.0
        if turning:
            aimed, slope, self.density_slope = Aimed.with_slopes(views, inverse_focal)
        depths = depths_of(aimed.depth_map(found.rotations, found.scales, found.covariance), aimed.views, inverse_focal)
        changed = slope * (1 + inverse_focal * depths)[..., None] + aimed.views * depths[..., None]
        plain, along = columns(centred(corrected(aimed.views, depths, inverse_focal))), columns(centred(changed))
        self.depths, self.inverse_focal, self.density = depths, inverse_focal, aimed.density
        self.grams = (plain @ plain.T / count, (plain @ along.T + along @ plain.T) / count, along @ along.T / count)
        self.scene = scene_at(
            self.grams[0], found.rotations, with_scales=found.scaled, ordered=found.covariance.ordered
        )

    def __call__(self, flat: Floats) -> tuple[float, Floats]:
        """Return E and its gradient."""
        frames, inverse_focal = len(self.depths), float(flat[-1])
        constant, linear, square = self.grams
        nearer, more = 1 + inverse_focal * self.depths, inverse_focal - self.inverse_focal
        if nearer.min() < MIN_RELATIVE_DISTANCE:
            return UNLIKELY, np.zeros_like(flat)
        gram = constant + more * linear + more**2 * square
        scene = replace(self.scene, gram=gram, factor=factor_of(gram))
        value, gradient, inverse = energy_with_inverse(scene, Motion.unflat(flat[:-1], frames))
        if inverse is None:
            return value, np.zeros_like(flat)
        slope = 0.5 * float(np.vdot(inverse, linear + 2 * more * square)) / frames
        slope += self.density_slope - 2 * float((self.depths / nearer).mean())
        value += density(self.depths, inverse_focal) + self.density + more * self.density_slope
        return value, np.append(gradient.flat(), slope)

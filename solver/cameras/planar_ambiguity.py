"""Cameras of a sheet: paper, cloth, a flag, whose image leaves open to which side it is tilted.

A plane at rest and the same plane mirrored at the image plane look alike under orthography, so that every frame of a thin sheet has
two poses, n̂ = (sin θ·u, cos θ) and (−sin θ·u, cos θ): Necker's reversal. A rigid factorization picks the sides that fit a constant
relief, although what relief there is comes from bending and changes its sign; all further refinement then stays on the wrong sides,
for between the two poses lies a steep ridge. The sides that let few modes of deformation explain the tracks are the right ones.

Therefore, for tracks that are nearly of rank two only: the poses of a plane, in closed form up to the sides; the sides
of which the camera is steadiest, in three senses, as starts; and from the best of them frames and runs of frames are reversed as
long as the likelihood with few modes rises. Scales stay free throughout, for the larger singular value of a plane's image is its scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.factorization import leading_factor
from pliant.solver.cameras.multistart import carried, gram_of
from pliant.solver.cameras.scale import rigid_scales
from pliant.solver.model.marginal_likelihood import Motion, Scene, cameras_of, fit, start
from pliant.solver.model.so3 import MIRROR, angles_between, from_rows, start_at_identity
from pliant.solver.records import Floats
from scipy.optimize import minimize

Sides = NDArray[np.bool_]

FLAT = 0.007
"""Third eigenvalue of W Wᵀ over the second below which the tracks are those of a sheet. Measured: bending paper .004, a waving flag
.005; faces that turn by 30° .01 to .08, bodies above .07."""

SHEET_FRAMES = 60
"""Longer sequences are unfolded on every n-th frame."""

MODES, NOISE, STEADY = 4, 1e-3, 0.03
"""Modes, noise floor and weight of the camera's unsteadiness. With many modes every choice of sides is explained in the end."""

TINY = float(np.finfo(np.float64).tiny)

SMALL_TILT = 1e-3
"""Weight of mean log 1/cos θ: of the planes that explain the singular values equally well, the least tilted."""

DEEP, SHORT = 100, 40
"""L-BFGS iterations of a start, and of each reversal that is tried."""

PASSES = 8
"""Reversals that are taken at most."""

TRIED_DEEPLY = 3
"""Reversals of one pass, the most promising first, that are fitted to the end before the pass gives up."""

EVERY = 24
"""Up to so many frames, every frame may be where the sheet turns over; in longer ones only where it faces the camera most."""

GAIN = 2e-3
"""Energy that a reversal must gain."""


@dataclass(frozen=True, slots=True, eq=False)
class Unfolded:
    """Cameras of a sheet."""

    rotations: Floats
    """Shape `(F, 3, 3)`."""

    scales: Floats
    """Shape `(F,)`, mean of the logarithm 0."""

    sides: Sides
    """Which frames show the reverse of the poses started from, shape `(F,)`."""

    motion: Motion
    energy: float


def is_flat(gram: Floats) -> bool:
    """Whether tracks with this Gram matrix are those of a thin sheet."""
    values = np.linalg.eigvalsh(gram)[::-1]
    return len(values) >= 6 and bool(values[2] < FLAT * values[1])


def frames_unfolded(count: int) -> slice:
    """Return which frames are unfolded: all of a short sequence."""
    return slice(None, None, -(-count // SHEET_FRAMES))


def on_its_sides(
    gram: Floats, rotations: Floats, *, should_stop: Callable[[], bool] | None = None
) -> tuple[Floats, str]:
    """Return the rotations of a sheet's cameras, and a sentence: the given ones, or more probable ones on other sides.

    Parameters
    ----------
    gram : shape (2F, 2F)
        W Wᵀ / P of centred, complete tracks.
    rotations : shape (F, 3, 3)
        The best that is known otherwise.
    should_stop : callable, optional
        Asked between fits; once it says True, the best so far is returned.
    """
    used = frames_unfolded(len(rotations))
    part, given = gram_of(gram, used), rotations[used]
    planes, scales = poses(gram)
    rival = fitted(part, given, rigid_scales(part, given), np.zeros(len(given), dtype=bool), should_stop=should_stop)
    found = unfold(part, planes[used], scales[used], should_stop=should_stop)
    if found.energy >= rival.energy:
        return rotations, "The tracks are those of a sheet; its sides are as they were."
    sides = np.repeat(found.sides, used.step)[: len(rotations)]
    after = start_at_identity(carried(reversed_at(planes, MIRROR, sides), found.rotations, used))
    turn = float(np.degrees(angles_between(after, rotations).mean()))
    return (
        after,
        f"The tracks are those of a sheet; other sides of it are more probable and turn it by {turn:.1f}° on average.",
    )


def unfold(
    gram: Floats, rotations: Floats, scales: Floats, *, should_stop: Callable[[], bool] | None = None
) -> Unfolded:
    """Return the cameras of the sheet on its most probable sides.

    Parameters
    ----------
    gram : shape (2F, 2F)
        W Wᵀ / P of centred, complete tracks.
    rotations, scales
        From `poses`.
    should_stop : callable, optional
        Asked before every fit; once it says True, the best so far is returned.
    """
    best: Unfolded | None = None
    for sides in _starts(rotations):
        if best is not None and should_stop is not None and should_stop():
            return best
        found = fitted(gram, reversed_at(rotations, MIRROR, sides), scales, sides, should_stop=should_stop)
        best = found if best is None or found.energy < best.energy else best
    assert best is not None
    return _settled(gram, best, should_stop)


def fitted(
    gram: Floats,
    rotations: Floats,
    scales: Floats,
    sides: Sides,
    *,
    iterations: int = DEEP,
    should_stop: Callable[[], bool] | None = None,
) -> Unfolded:
    """Return the cameras of highest likelihood near the given ones."""
    scene = Scene(
        gram, rotations, with_scales=True, steadiness=STEADY, noise_floor=NOISE,
        smoothness=0.0,
    )  # fmt: skip
    begun = replace(start(scene, scales, num_modes=MODES), logs=np.log([0.01, 0.05]))
    motion, energy = fit(scene, begun, iterations=iterations, turning=True, should_stop=should_stop)
    return Unfolded(*cameras_of(scene, motion), sides, motion, energy)


def poses(gram: Floats) -> tuple[Floats, Floats]:
    """Return rotations and scales of a plane with this image, each frame on either side.

    The rank-2 factor of W is, up to one 2×2 matrix T, s_f times the first two columns of R_f's rows, whose singular values are s_f
    and s_f cos θ_f. T is the one with the most even scales; where several are equally even, as when the plane turns about one axis,
    the one with the least tilt.
    """
    factor = leading_factor(gram, 2)

    def uneven(values: Floats) -> float:
        large, small = np.moveaxis(np.linalg.svd(factor @ _lower(values), compute_uv=False), -1, 0)
        large = np.maximum(large, 1e-9 * max(float(large.max()), TINY))
        tilt = np.log(large / np.maximum(small, 1e-9 * large))
        return float(np.mean(np.log(large) ** 2) + SMALL_TILT * np.mean(tilt))

    begun = np.array([[0.0, 0, 0], [0.5, 0, -0.5], [-0.5, 0, 0.5], [0, 0.5, 0], [0, -0.5, 0]])
    runs = [minimize(uneven, one, method="Nelder-Mead", options={"maxiter": 2000, "xatol": 1e-6}) for one in begun]
    found = min(runs, key=lambda run: float(run.fun)).x
    left, values, right = np.linalg.svd(factor @ _lower(found))
    values = np.maximum(values, 1e-9 * max(float(values.max()), TINY))
    cosine = values[:, 1] / values[:, 0]
    across = np.sqrt(np.maximum(1 - cosine**2, 0.0))[:, None] * left[:, :, 1]
    flat = (left * np.stack([np.ones_like(cosine), cosine], axis=1)[:, None]) @ right
    rows = np.concatenate([flat, across[..., None]], axis=2)
    return from_rows(rows), np.exp(np.log(values[:, 0]) - np.log(values[:, 0]).mean())


def reversed_at(rotations: Floats, plane: Floats, sides: Sides) -> Floats:
    """Return the rotations with the sheet seen from the other side in some frames: D R H, H the mirror at the sheet's plane."""
    return np.where(sides[:, None, None], MIRROR @ rotations @ plane, rotations)


def _lower(values: Floats) -> Floats:
    return np.array([[np.exp(values[0]), 0.0], [values[1], np.exp(values[2])]])


def _starts(rotations: Floats) -> list[Sides]:
    """Return choices of sides: as they are, those that turn least, and those whose turn changes least; each once."""
    kept: list[Sides] = []
    for sides in (np.zeros(len(rotations), dtype=bool), steadiest(rotations, 1), steadiest(rotations, 2)):
        if not any((sides == other).all() or (sides != other).all() for other in kept):
            kept.append(sides)
    return kept


def steadiest(rotations: Floats, order: int) -> Sides:
    """Return the sides that minimise Σ ‖R_{f+1} − R_f‖² (order 1) or Σ ‖T_f − T_{f−1}‖², T_f = R_{f+1} R_fᵀ (order 2): Viterbi.

    States are the sides of two successive frames.
    """
    both = np.stack([rotations, MIRROR @ rotations @ MIRROR], axis=1)
    turns = np.einsum("fjab,ficb->fijac", both[1:], both[:-1])
    steps = np.square(turns - np.eye(3)).sum(axis=(-1, -2))
    cost, back = steps[0] * (order == 1), []
    for index in range(1, len(turns)):
        change = np.square(turns[index][None] - turns[index - 1][:, :, None]).sum(axis=(-1, -2))
        total = cost[:, :, None] + (change if order == 2 else steps[index][None])
        back.append(total.argmin(axis=0))
        cost = total.min(axis=0)
    before, here = np.unravel_index(int(cost.argmin()), (2, 2))
    sides = [bool(here), bool(before)]
    for choice in back[::-1]:
        before, here = choice[before, here], before
        sides.append(bool(before))
    return np.array(sides[::-1])


def _settled(gram: Floats, found: Unfolded, should_stop: Callable[[], bool] | None) -> Unfolded:
    """Return the cameras after all reversals, one after the other, that raise the likelihood."""
    for _ in range(PASSES):
        plane, tried = _plane(found.motion), []
        for run in _runs(found.rotations @ plane[1]):
            if should_stop is not None and should_stop():
                return found
            turned = reversed_at(found.rotations, plane[0], run)
            tried.append(
                fitted(gram, turned, found.scales, found.sides ^ run, iterations=SHORT, should_stop=should_stop)
            )
        tried.sort(key=lambda each: each.energy)
        better = None
        for each in tried[:TRIED_DEEPLY]:
            deep = fitted(gram, each.rotations, each.scales, each.sides, should_stop=should_stop)
            if deep.energy < found.energy - GAIN:
                better = deep
                break
        if better is None:
            break
        found = better
    return found


def _plane(motion: Motion) -> tuple[Floats, Floats]:
    """Return the mirror at the mean sheet's plane (3×3), and its normal (3,)."""
    root = np.zeros((3, 3))
    root[np.tril_indices(3)] = motion.extent
    normal = np.linalg.eigh(root @ root.T)[1][:, 0]
    return np.eye(3) - 2 * np.outer(normal, normal), normal


def _runs(normals: Floats) -> list[Sides]:
    """Return the runs of frames worth reversing, given the sheet's normal in each frame's camera, shape `(F, 3)`.

    They lie between two neighbouring places where the sheet may turn over, or reach from such a place to the end.
    """
    frames = len(normals)
    facing = np.abs(normals[:, 2])
    every = range(1, frames)
    most = [f for f in range(1, frames - 1) if facing[f] >= facing[f - 1] and facing[f] > facing[f + 1]]
    places = list(every) if frames <= EVERY else most
    edges = [0, *places, frames]
    spans = {(a, b) for a, b in pairwise(edges)} | {(a, frames) for a in places}
    index = np.arange(frames)
    return [(index >= a) & (index < b) for a, b in sorted(spans - {(0, frames)})]

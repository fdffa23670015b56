"""Cameras of a planar object (paper, cloth, a flag), whose image does not determine the sign of its tilt.

A plane and its mirror image in the image plane look alike under orthography, so every frame of a thin sheet has two
poses, n̂ = (sin θ·u, cos θ) and (−sin θ·u, cos θ): Necker reversal. A rigid factorization selects the pose signs that
fit a constant relief, although the relief of a sheet is due to bending and changes sign. Refinement cannot correct
these signs, since an energy barrier separates the two poses. With the correct signs, few modes of deformation explain
the tracks.

For tracks of nearly rank two, a rank-2 factorization gives the poses of a plane up to their signs. The search starts
from the given cameras, from these poses, and from the sign choices with the smoothest camera of first and of second
order. From the best start, frames and runs of frames are reversed while the likelihood with few modes improves. Scales
stay free, because the larger singular value of a plane's image is its scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.factorization import leading_eigenpairs, leading_factor
from pliant.solver.cameras.multistart import carried, continued
from pliant.solver.cameras.scale import rigid_scales
from pliant.solver.model.marginal_likelihood import Motion, Scene, cameras_of, fit, start
from pliant.solver.model.so3 import MIRROR, angles_between, from_rows, start_at_identity
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, Tracks
from pliant.solver.tracks.frame_selection import every_nth, of_frames
from scipy.optimize import minimize

PoseSigns = NDArray[np.bool_]

MAX_PLANAR_RATIO = 0.007
"""Ratio of the third to the second eigenvalue of W Wᵀ below which the object counts as planar: paper .004, a flag
.005, faces that rotate by 30° .01 to .08, bodies above .07."""

PLANAR_FRAMES = 60
"""Maximum number of frames for the search; longer sequences use every n-th frame."""

PLANAR_MODES, PLANAR_NOISE_STD, PLANAR_PRIOR_WEIGHT = 4, 1e-3, 0.03
"""Number of modes, noise floor (standard deviation, normalized units) and weight of the camera-motion prior. With
many modes every choice of signs fits."""

SMALLEST_SCALE = float(np.finfo(np.float64).tiny)

SMALL_TILT = 1e-3
"""Weight of mean log 1/cos θ: selects the least tilted of the planes that fit equally well."""

FULL_ITERATIONS, TRIAL_ITERATIONS = 100, 40
"""L-BFGS iterations of a full fit, and of each trial reversal."""

PASSES = 8
"""Maximum number of accepted reversals."""

MAX_FULL_FITS = 3
"""Number of trial reversals per pass, lowest energy first, that get a full fit."""

MAX_EXHAUSTIVE_FRAMES = 24
"""Maximum number of frames for which a reversal may start at every frame; in longer sequences it starts only where
the plane faces the camera most."""

MIN_REVERSAL_GAIN = 2e-3
"""Minimum decrease of the energy per point and frame for a reversal to be accepted."""


@dataclass(frozen=True, slots=True, eq=False)
class PlanarCameras:
    """Cameras of a planar object."""

    rotations: Floats
    """Shape `(F, 3, 3)`."""

    scales: Floats
    """Shape `(F,)`, mean of the logarithm 0."""

    pose_signs: PoseSigns
    """True for frames whose pose is reversed relative to the start, shape `(F,)`."""

    motion: Motion
    energy: float


def is_planar(gram: Floats) -> bool:
    """Whether tracks with this Gram matrix show a planar object; points on one line count as planar."""
    if len(gram) < 6:
        return False
    values, _ = leading_eigenpairs(gram, 3)
    # For points on a line, the second eigenvalue is noise.
    return bool(values[2] < MAX_PLANAR_RATIO * max(values[1], MAX_PLANAR_RATIO * values[0]))


def on_one_line(tracks: Tracks) -> bool:
    """Whether the points of most frames lie on one line; a perspective correction can hide this from `is_planar`."""
    flat = []
    for points, visible in zip(tracks.points, tracks.visible, strict=True):
        shown = points[visible > 0]
        if len(shown) >= 3:
            values = np.linalg.eigvalsh(np.cov(shown.T))
            flat.append(bool(values[0] <= MAX_PLANAR_RATIO**2 * values[1]))  # the bound of a line in `is_planar`
    return bool(flat) and sum(flat) > len(flat) / 2


def resolve_pose_signs(
    gram: Floats, rotations: Floats, *, ordered: bool = True, should_stop: ShouldStop = never
) -> tuple[Floats, Floats | None, str]:
    """Return the rotations of a planar object, with other pose signs if more probable; an alternative or None; and a sentence.

    If the given rotations are the best start and reversing some of their poses improves the likelihood with few modes, the
    reversed ones are the alternative. They may be right for a sheet and wrong for a shallow solid: the likelihood with the
    shapes must decide.

    Parameters
    ----------
    gram : shape (2F, 2F)
        W Wᵀ / P of centred, complete tracks.
    rotations : shape (F, 3, 3)
        The best cameras so far.
    ordered : bool
        False for photographs in no order: no camera-motion prior, no smooth starts, and frames are reversed one by one.
    should_stop : callable, optional
        Called between fits; once it returns True, the best so far is returned.
    """
    used = every_nth(len(rotations), PLANAR_FRAMES)
    part, given = of_frames(gram, used), rotations[used]
    planes, scales = poses(gram)
    starts = [(rotations, rigid_scales(part, given))]
    starts += [
        (reversed_at(planes, MIRROR, _of_all_frames(pose_signs, used, len(planes))), scales[used])
        for pose_signs in _starts(planes[used], ordered=ordered)
    ]
    fits: list[PlanarCameras] = []
    for begun, sizes in starts:
        if fits and should_stop():
            break
        fits.append(fitted(part, begun[used], sizes, ordered=ordered, should_stop=should_stop))
    best = min(fits, key=lambda each: each.energy)
    found = _reverse_greedily(part, best, should_stop, ordered=ordered)
    as_before = "The tracks are nearly those of a plane; the pose signs are unchanged."
    if found is fits[0]:
        return rotations, None, as_before
    begun, _ = starts[fits.index(best)]
    pose_signs = _of_all_frames(found.pose_signs, used, len(planes))
    before = reversed_at(begun, _plane(found.motion)[0], pose_signs)
    if ordered:
        after = continued(gram, before, found.rotations, used, should_stop=should_stop)
    else:
        after = carried(before, found.rotations, used)
    after = start_at_identity(after)
    if best is fits[0]:
        return rotations, after, f"{as_before} Cameras with some poses reversed are an additional start."
    turn = float(np.degrees(angles_between(after, rotations).mean()))
    why = f"other pose signs are more probable; rotations change by {turn:.1f}° on average."
    return after, None, f"The tracks are nearly those of a plane; {why}"


def fitted(
    gram: Floats,
    rotations: Floats,
    scales: Floats,
    *,
    pose_signs: PoseSigns | None = None,
    iterations: int = FULL_ITERATIONS,
    ordered: bool = True,
    should_stop: ShouldStop = never,
) -> PlanarCameras:
    """Return the most probable cameras near the given ones; `pose_signs` (None: no reversals) are only recorded."""
    pose_signs = np.zeros(len(rotations), dtype=bool) if pose_signs is None else pose_signs
    scene = Scene(
        gram, rotations, with_scales=True, prior_weight=PLANAR_PRIOR_WEIGHT * ordered,
        noise_std_floor=PLANAR_NOISE_STD, smoothness=0.0, ordered=ordered,
    )  # fmt: skip
    begun = replace(start(scene, scales, num_modes=PLANAR_MODES), logs=np.log([0.01, 0.05]))
    motion, energy = fit(scene, begun, iterations=iterations, turning=True, should_stop=should_stop)
    return PlanarCameras(*cameras_of(scene, motion), pose_signs, motion, energy)


def poses(gram: Floats) -> tuple[Floats, Floats]:
    """Return rotations and scales of a plane with this image; the sign of each pose is arbitrary.

    The rank-2 factor of W is, up to one 2×2 matrix T, s_f times the first two columns of R_f's rows, whose singular
    values are s_f and s_f cos θ_f. T is chosen for the most even scales and, if these are equally even, as in rotation
    about one axis, for the least tilt.
    """
    factor = leading_factor(gram, 2)

    def unevenness(values: Floats) -> float:
        large, small = np.moveaxis(np.linalg.svd(factor @ _lower(values), compute_uv=False), -1, 0)
        large = np.maximum(large, 1e-9 * max(float(large.max()), SMALLEST_SCALE))
        tilt = np.log(large / np.maximum(small, 1e-9 * large))
        return float(np.mean(np.log(large) ** 2) + SMALL_TILT * np.mean(tilt))

    begun = np.array([[0.0, 0, 0], [0.5, 0, -0.5], [-0.5, 0, 0.5], [0, 0.5, 0], [0, -0.5, 0]])
    runs = [minimize(unevenness, one, method="Nelder-Mead", options={"maxiter": 2000, "xatol": 1e-6}) for one in begun]
    found = min(runs, key=lambda run: float(run.fun)).x
    left, values, right = np.linalg.svd(factor @ _lower(found))
    values = np.maximum(values, 1e-9 * max(float(values.max()), SMALLEST_SCALE))
    cosine = values[:, 1] / values[:, 0]
    across = np.sqrt(np.maximum(1 - cosine**2, 0.0))[:, None] * left[:, :, 1]
    flat = (left * np.stack([np.ones_like(cosine), cosine], axis=1)[:, None]) @ right
    rows = np.concatenate([flat, across[..., None]], axis=2)
    return from_rows(rows), np.exp(np.log(values[:, 0]) - np.log(values[:, 0]).mean())


def _of_all_frames(pose_signs: PoseSigns, used: NDArray[np.intp], frames: int) -> PoseSigns:
    """Return the pose signs of all frames, repeated from the frames used, shape `(F,)`."""
    return np.asarray(np.repeat(pose_signs, np.diff(used, append=frames)), dtype=bool)


def reversed_at(rotations: Floats, plane: Floats, pose_signs: PoseSigns) -> Floats:
    """Return the rotations with the pose of some frames reversed: D R H, with D the depth mirror and H that of the object's plane."""
    return np.where(pose_signs[:, None, None], MIRROR @ rotations @ plane, rotations)


def _lower(values: Floats) -> Floats:
    return np.array([[np.exp(values[0]), 0.0], [values[1], np.exp(values[2])]])


def _starts(rotations: Floats, *, ordered: bool) -> list[PoseSigns]:
    """Return distinct choices of pose signs: as given, least rotation, least change of rotation."""
    kept: list[PoseSigns] = []
    smooth = [smoothest_signs(rotations, 1), smoothest_signs(rotations, 2)] if ordered else []
    for pose_signs in (np.zeros(len(rotations), dtype=bool), *smooth):
        if not any((pose_signs == other).all() or (pose_signs != other).all() for other in kept):
            kept.append(pose_signs)
    return kept


def smoothest_signs(rotations: Floats, order: int) -> PoseSigns:
    """Return the pose signs of the smoothest camera, by the Viterbi algorithm.

    Order 1 minimises Σ ‖R_{f+1} − R_f‖², order 2 Σ ‖T_f − T_{f−1}‖² with T_f = R_{f+1} R_fᵀ. States are the signs of
    two successive frames.
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
    pose_signs = [bool(here), bool(before)]
    for choice in back[::-1]:
        before, here = choice[before, here], before
        pose_signs.append(bool(before))
    return np.array(pose_signs[::-1])


def _reverse_greedily(gram: Floats, found: PlanarCameras, should_stop: ShouldStop, *, ordered: bool) -> PlanarCameras:
    """Return the cameras after greedy reversals, each of which improves the likelihood."""
    for _ in range(PASSES):
        plane, tried = _plane(found.motion), []
        for run in _runs(found.rotations @ plane[1]) if ordered else np.eye(len(found.rotations), dtype=bool):
            if should_stop():
                return found
            turned = reversed_at(found.rotations, plane[0], run)
            tried.append(
                fitted(
                    gram,
                    turned,
                    found.scales,
                    pose_signs=found.pose_signs ^ run,
                    iterations=TRIAL_ITERATIONS,
                    ordered=ordered,
                    should_stop=should_stop,
                )
            )
        tried.sort(key=lambda each: each.energy)
        better = None
        for each in tried[:MAX_FULL_FITS]:
            deep = fitted(
                gram, each.rotations, each.scales, pose_signs=each.pose_signs, ordered=ordered, should_stop=should_stop
            )
            if deep.energy < found.energy - MIN_REVERSAL_GAIN:
                better = deep
                break
        if better is None:
            break
        found = better
    return found


def _plane(motion: Motion) -> tuple[Floats, Floats]:
    """Return the reflection in the plane of the mean shape (3×3), and the plane's normal (3,)."""
    root = np.zeros((3, 3))
    root[np.tril_indices(3)] = motion.mean_root
    normal = np.linalg.eigh(root @ root.T)[1][:, 0]
    return np.eye(3) - 2 * np.outer(normal, normal), normal


def _runs(normals: Floats) -> list[PoseSigns]:
    """Return the runs of frames whose reversal is tried, given the plane's normal in each camera, shape `(F, 3)`.

    A run extends from one candidate frame to the next, or to the end.
    """
    frames = len(normals)
    facing = np.abs(normals[:, 2])
    every = range(1, frames)
    most = [f for f in range(1, frames - 1) if facing[f] >= facing[f - 1] and facing[f] > facing[f + 1]]
    places = list(every) if frames <= MAX_EXHAUSTIVE_FRAMES else most
    edges = [0, *places, frames]
    spans = {(a, b) for a, b in pairwise(edges)} | {(a, frames) for a in places}
    index = np.arange(frames)
    return [(index >= a) & (index < b) for a, b in sorted(spans - {(0, frames)})]

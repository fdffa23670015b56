"""Resection: cameras and deformations of frames outside those that the covariance was learned from, by posterior mean shapes.

A covariance learned from some frames of a film (`model.shape_covariance`) gives each of their points a posterior mean position μ_p and
posterior mean modes b_kp. Every frame of the film is then

    w_fp = s_f R_f (μ_p + Σ_k l_fk b_kp) + t_f + noise,

a non-linear least-squares problem with 6 + k unknowns, 5 + k without scales. Frames are independent, so the cost is linear in their
number. Residuals have the Cauchy loss. R_f and l_f have Gaussian priors about the interpolation between the learned neighbours, with the
covariances of the learned frames' deviations from the middle of theirs: slow motion is interpolated, fast motion follows the images.
Levenberg–Marquardt on SO(3) (Hartley and Zisserman, Multiple View Geometry, 2004, 7.2 and A6), many frames at once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.model.image_density import Explained
from pliant.solver.model.marginal_likelihood import root_matrix
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import exponential, from_rows, logarithm
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, projections_of
from pliant.solver.threads import over_ranges
from pliant.solver.tracks.frame_selection import between
from pliant.solver.tracks.matrix import columns
from scipy.spatial.transform import Rotation, Slerp

MAX_STEPS = 12
"""Maximum number of Levenberg–Marquardt steps per frame."""

SETTLED = 1e-5
"""Relative decrease of a frame's cost below which it has converged."""

FRAMES_TOGETHER = 16
"""Frames whose normal equations are formed at once; bounds the memory."""

OUTLYING = 3.0
"""Residual, in standard deviations, at which the Cauchy loss halves a weight, as in `tracks.completion`."""

LEARNED_DOUBT = 1e-3
"""Prior variance in a learned frame relative to that midway between two; learned frames hardly move."""

MIN_RELATIVE_DISTANCE = 0.2
"""Minimum of 1 + κz: no point is nearer to the camera than a fifth of the distance of the shape's origin."""


@dataclass(frozen=True, slots=True, eq=False)
class MeanShapes:
    """Posterior mean shape and modes of each point, given the learned frames."""

    mean: Floats
    """μ, shape `(3, S)`."""

    modes: Floats
    """b, shape `(k, 3, S)`."""

    precision: Floats
    """Inverse covariance of the coefficients l_f midway between two learned frames about their mean, shape `(k, k)`."""

    turn_precision: Floats
    """Likewise for the rotation vector of R_f relative to its mean, shape `(3, 3)`."""

    variance: float
    """Variance of an image coordinate about its prediction: noise and random walk."""

    @classmethod
    def of(cls, covariance: ShapeCovariance, rotations: Floats, scales: Floats, sample: Floats) -> MeanShapes:
        """Return the shapes for cameras and complete tracks `(F, S, 2)` of the frames that the covariance was learned from."""
        projections = projections_of(rotations, scales)
        found = Explained.of(covariance.image_model(projections), columns(sample)).means
        found = found.reshape(covariance.modes.shape[1] + 1, 3, -1)
        off = covariance.modes[1:-1] - (covariance.modes[:-2] + covariance.modes[2:]) / 2
        middle = exponential(logarithm(rotations[2:] @ rotations[:-2].transpose(0, 2, 1)) / 2) @ rotations[:-2]
        turn = logarithm(rotations[1:-1] @ middle.transpose(0, 2, 1))
        return cls(
            root_matrix(covariance.mean_covariance) @ found[0],
            root_matrix(covariance.axis_covariance) @ found[1:],
            _precision(off),
            _precision(turn),
            covariance.noise_variance + covariance.walk_variance,
        )

    def at(self, coefficients: Floats) -> Floats:
        """Return the shapes for coefficients `(n, k)`, shape `(n, 3, S)`."""
        moved = coefficients @ self.modes.reshape(len(self.modes), self.mean.size)
        return np.asarray(self.mean + moved.reshape(len(coefficients), *self.mean.shape))


def _precision(deviations: Floats) -> Floats:
    """Return the inverse of the second moment of deviations `(n, m)`, regularised."""
    moment = deviations.T @ deviations / max(len(deviations), 1)
    ridge = 1e-9 * max(float(np.trace(moment)), 1e-3)
    return np.asarray(np.linalg.inv(moment + ridge * np.eye(len(moment))))


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Tracks of the points in the frames to resect."""

    points: Floats
    """Shape `(n, 2, S)`, relative to the principal point if `inverse_focal` is not 0."""

    weight: Floats
    """Shape `(n, S)`."""

    inverse_focal: float = 0.0
    """κ."""

    def part(self, chosen: slice | NDArray[np.intp]) -> Views:
        """Return the chosen frames."""
        return replace(self, points=self.points[chosen], weight=self.weight[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Unknowns of the frames, and their priors."""

    rotations: Floats
    """Shape `(n, 3, 3)`."""

    scales: Floats
    """Shape `(n,)`."""

    coefficients: Floats
    """l, shape `(n, k)`."""

    translations: Floats
    """Shape `(n, 2)`."""

    expected: Floats
    """Prior mean of l, shape `(n, k)`."""

    expected_rotations: Floats
    """Prior mean of the rotations, shape `(n, 3, 3)`."""

    doubt: Floats
    """Prior variances relative to those midway between learned frames, shape `(n,)`."""

    def part(self, chosen: slice | NDArray[np.intp]) -> Poses:
        """Return the chosen frames."""
        return Poses(*(getattr(self, each.name)[chosen] for each in fields(self)))

    def where(self, better: NDArray[np.bool_], other: Poses) -> Poses:
        """Return these poses, replaced by those of `other` in the frames where `better`."""
        pairs = ((getattr(self, each.name), getattr(other, each.name)) for each in fields(self))
        return Poses(*(np.where(better.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in pairs))


def rotations_between(used: NDArray[np.intp], rotations: Floats, frames: int) -> Floats:
    """Return rotations of all frames, interpolated between the frames `used` on the shortest path, shape `(F, 3, 3)`."""
    path = Slerp(used, Rotation.from_matrix(rotations))
    found: Floats = path(np.clip(np.arange(frames), used[0], used[-1])).as_matrix()
    found[used] = rotations
    return found


def interpolated(used: NDArray[np.intp], rotations: Floats, scales: Floats, modes: Floats, num_frames: int) -> Poses:
    """Return the poses of all frames of a film, interpolated between those of the frames used."""
    at = np.clip(np.arange(num_frames), used[0], used[-1])
    turned = rotations_between(used, rotations, num_frames)
    coefficients = between(used, modes, num_frames)
    before = np.clip(np.searchsorted(used, at, side="right") - 1, 0, len(used) - 2)
    share = (at - used[before]) / (used[before + 1] - used[before])
    doubt = np.where(at == np.arange(num_frames), np.maximum(4 * share * (1 - share), LEARNED_DOUBT), 1.0)
    scales = np.exp(between(used, np.log(scales), num_frames))
    return Poses(turned, scales, coefficients, np.zeros((num_frames, 2)), coefficients, turned, doubt)


def resected(
    views: Views,
    shapes: MeanShapes,
    start: Poses,
    *,
    turning: bool,
    with_scales: bool,
    should_stop: ShouldStop = never,
) -> Poses:
    """Return the most probable pose of every frame.

    Parameters
    ----------
    views : Views
        n frames of S points.
    shapes : MeanShapes
        Shapes of the same points.
    start : Poses
        Starting poses. If `turning`, frames also start at the best pose of the mean shape; the more probable result is returned.
    turning : bool
        False keeps the rotations.
    with_scales : bool
        False keeps the scales.
    should_stop : callable, optional
        Called between groups of frames; once it returns True, the remaining frames keep their starting poses.
    """
    done: list[Poses] = []
    group = 2 * FRAMES_TOGETHER
    for low in range(0, len(views.points), 8 * group):
        block = slice(low, min(low + 8 * group, len(views.points)))
        if should_stop():
            done.append(start.part(slice(low, None)))
            break
        done.append(_resected(views.part(block), shapes, start.part(block), turning, with_scales))
    return Poses(*(np.concatenate([getattr(each, name.name) for each in done]) for name in fields(Poses)))


def _resected(views: Views, shapes: MeanShapes, start: Poses, turning: bool, with_scales: bool) -> Poses:
    count = len(views.points)
    groups = range(0, count, FRAMES_TOGETHER)
    found: list[Poses | None] = [None] * len(groups)

    def work(first: int, last: int) -> None:
        for number in range(first, last):
            chosen = slice(groups[number], min(groups[number] + FRAMES_TOGETHER, count))
            part, begun = views.part(chosen), start.part(chosen)
            best, cost = _descended(part, shapes, begun, turning, with_scales)
            if turning:
                other, its_cost = _descended(part, shapes, rigid(part, shapes, begun), turning, with_scales)
                best = best.where(its_cost < cost, other)
            found[number] = best

    over_ranges(work, len(groups))
    return Poses(*(np.concatenate([getattr(each, name.name) for each in found]) for name in fields(Poses)))


def rigid(views: Views, shapes: MeanShapes, begun: Poses) -> Poses:
    """Return the poses in which the undeformed mean shape fits best: the rotation nearest to an affine camera."""
    weight = views.weight[:, None]
    total = np.maximum(weight.sum(axis=2, keepdims=True), np.finfo(float).tiny)
    middle = (weight * views.points).sum(axis=2, keepdims=True) / total
    centre = (weight * shapes.mean).sum(axis=2, keepdims=True) / total
    mean = shapes.mean - centre
    normal = (weight * mean) @ mean.transpose(0, 2, 1)
    normal += 1e-6 * np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-12)[:, None, None] * np.eye(3)
    affine = np.linalg.solve(normal, (weight * mean) @ (views.points - middle).transpose(0, 2, 1)).transpose(0, 2, 1)
    rotations = from_rows(affine)
    moved = (middle - begun.scales[:, None, None] * rotations[:, :2] @ centre)[..., 0]
    return replace(begun, rotations=rotations, coefficients=begun.expected, translations=moved)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Residuals at a pose, and what its derivatives need."""

    turned: Floats
    """s R x, shape `(n, 3, S)`."""

    left: Floats
    """Residuals, shape `(n, 2, S)`."""

    omega: Floats
    """Robust weights divided by the variance, shape `(n, S)`."""

    cost: Floats
    """Negative log posterior, shape `(n,)`."""


def predicted(shapes: MeanShapes, poses: Poses, inverse_focal: float) -> tuple[Floats, Floats, Floats]:
    """Return s R x `(n, 3, S)`, the images under orthography, translations included `(n, 2, S)`, and 1 + κz `(n, S)`."""
    turned = poses.scales[:, None, None] * (poses.rotations @ shapes.at(poses.coefficients))
    depths = turned[:, 2] - turned[:, 2].mean(axis=1, keepdims=True)
    return (
        turned,
        turned[:, :2] + poses.translations[:, :, None],
        np.maximum(1 + inverse_focal * depths, MIN_RELATIVE_DISTANCE),
    )


def _turn(poses: Poses) -> Floats:
    """Return the rotation vectors relative to the prior mean, shape `(n, 3)`."""
    return logarithm(poses.rotations @ poses.expected_rotations.transpose(0, 2, 1))


def _fit(views: Views, shapes: MeanShapes, poses: Poses) -> _Fit:
    turned, image, nearer = predicted(shapes, poses, views.inverse_focal)
    left = views.points * nearer[:, None] - image
    far = OUTLYING**2 * shapes.variance
    squared = (left**2).sum(axis=1)
    omega = views.weight / (1 + squared / far) / shapes.variance
    cost = 0.5 * far / shapes.variance * (views.weight * np.log1p(squared / far)).sum(axis=1)
    off, turn = poses.coefficients - poses.expected, _turn(poses)
    held = np.einsum("nk,kl,nl->n", off, shapes.precision, off)
    held = (held + np.einsum("nk,kl,nl->n", turn, shapes.turn_precision, turn)) / poses.doubt
    return _Fit(turned, left, omega, cost + 0.5 * held)


def _descended(
    views: Views, shapes: MeanShapes, poses: Poses, turning: bool, with_scales: bool
) -> tuple[Poses, Floats]:
    """Return poses and their costs after Levenberg–Marquardt steps."""
    at = _fit(views, shapes, poses)
    damping = np.full(len(at.cost), 1e-3)
    for _ in range(MAX_STEPS):
        trial = _stepped(shapes, poses, at, damping, turning, with_scales)
        new = _fit(views, shapes, trial)
        better = new.cost < at.cost
        gain = np.where(better, (at.cost - new.cost) / np.maximum(np.abs(at.cost), 1e-12), 0.0)
        poses = poses.where(better, trial)
        pick = better.reshape(-1, 1, 1)
        at = _Fit(
            np.where(pick, new.turned, at.turned), np.where(pick, new.left, at.left),
            np.where(better[:, None], new.omega, at.omega), np.where(better, new.cost, at.cost),
        )  # fmt: skip
        damping = np.where(better, 0.2 * damping, 10 * damping)
        if (gain < SETTLED).all() and better.any():
            break
        if damping.min() > 1e4:
            break
    return poses, at.cost


def _stepped(shapes: MeanShapes, poses: Poses, at: _Fit, damping: Floats, turning: bool, with_scales: bool) -> Poses:
    """Return the poses after a damped Gauss–Newton step."""
    frames, count, points = len(at.cost), len(shapes.modes), shapes.mean.shape[1]
    slopes = np.zeros((frames, count + 6, 2, points))
    cameras = projections_of(poses.rotations, poses.scales)
    modes = cameras @ shapes.modes.transpose(1, 0, 2).reshape(3, -1)
    slopes[:, :count] = modes.reshape(frames, 2, count, points).transpose(0, 2, 1, 3)
    slopes[:, count, 0] = slopes[:, count + 1, 1] = 1.0
    if turning:
        x, y, z = at.turned[:, 0], at.turned[:, 1], at.turned[:, 2]
        slopes[:, count + 2, 1], slopes[:, count + 3, 0] = -z, z
        slopes[:, count + 4, 0], slopes[:, count + 4, 1] = -y, x
    if with_scales:
        slopes[:, count + 5] = at.turned[:, :2]
    flat = slopes.reshape(frames, count + 6, -1)
    weighted = (slopes * at.omega[:, None, None]).reshape(flat.shape)
    normal = weighted @ flat.transpose(0, 2, 1)
    right = (weighted @ at.left.reshape(frames, -1, 1))[..., 0]
    normal[:, :count, :count] += shapes.precision / poses.doubt[:, None, None]
    right[:, :count] -= (poses.coefficients - poses.expected) @ shapes.precision / poses.doubt[:, None]
    if turning:
        turns = slice(count + 2, count + 5)
        normal[:, turns, turns] += shapes.turn_precision / poses.doubt[:, None, None]
        right[:, turns] -= _turn(poses) @ shapes.turn_precision / poses.doubt[:, None]
    each = np.arange(count + 6)
    diagonal = normal[:, each, each]
    floor = 1e-9 * np.maximum(diagonal.max(axis=1, keepdims=True), np.finfo(float).tiny)
    normal[:, each, each] += damping[:, None] * diagonal + floor
    step = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], dtype=np.float64)
    return replace(
        poses,
        rotations=exponential(step[:, count + 2 : count + 5]) @ poses.rotations,
        scales=poses.scales * np.exp(np.clip(step[:, count + 5], -1.0, 1.0)),
        coefficients=poses.coefficients + step[:, :count],
        translations=poses.translations + step[:, count : count + 2],
    )

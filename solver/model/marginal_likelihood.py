"""How probable the tracks are under cameras, whatever the shapes: the energy with the shapes eliminated.

A point's world positions over all frames are taken as Gaussian: a mean position with covariance A₀ (3×3, the object's extents)
plus a deformation whose frames covary by C (F×F) and whose axes covary by A₁. Its image positions then have the covariance

    M = σ² I + Π (1 1ᵀ ⊗ A₀ + C ⊗ A₁) Πᵀ,    Π = blockdiag(s_f R_f),    C = L Lᵀ + τ² T,

and with G = W Wᵀ / P the negative log-likelihood of one point and frame is

    E = (log det M + tr M⁻¹ G) / 2F.

The trace is variable projection: tr M⁻¹ G is what min_S ‖W − Π S‖²/σ² + ‖S‖²_prior leaves. Alone it falls when depth is
traded for rotation (a flat shape that turns faster moves the same in the image). The log-determinant is what a smoothness
energy lacks: a prior that expects less depth explains less and must pay. T is the covariance of a random walk, the modes
L (F×q) are the low-rank part, and κ‖H L‖²/2F keeps them smooth: without it every frame is turned to fit the mean shape best,
and a talking face nods with its jaw. What binds the cameras is in
`model.camera_motion_prior`. Everything lives in 2F dimensions; P does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pliant.solver.model.camera_motion_prior import unevenness, unsteadiness
from pliant.solver.model.so3 import exponential, left_jacobian, vee
from pliant.solver.records import Floats
from scipy.linalg import lapack
from scipy.optimize import minimize

NOISE_FLOOR = 3e-3
"""Normalised units. No tracks of real video are better, and a finer one spends the model's modes on what no camera explains:
measured, 1e-4 leaves L-BFGS unconverged after 200 iterations, with 3e-3 different starts reach the same cameras."""

STEADINESS = 0.05
"""Weight of `model.camera_motion_prior`, whose terms are those of one camera, against E, which is that of one point: the points
of a surface move together and are worth about 1/0.05 independent ones."""

SMOOTHNESS = 1000.0
"""κ."""

NUM_MODES = 16
"""q."""

UNLIKELY = 1e6
"""Energy reported where M is not positive definite to rounding; the line search steps back from it."""

LOWER = np.tril_indices(3)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Parameters of the density; a gradient has the same fields."""

    turns: Floats
    """Rotation vectors that turn the start's cameras: R_f = exp(turns_f) R_f⁰, shape `(F, 3)`."""

    log_scales: Floats
    """Shape `(F,)`; only their differences from the mean count."""

    modes: Floats
    """L, shape `(F, q)`."""

    extent: Floats
    """Lower triangle of a root of A₀, shape `(6,)`."""

    play: Floats
    """Lower triangle of a root of A₁, shape `(6,)`."""

    logs: Floats
    """log σ and log τ, shape `(2,)`."""

    def flat(self) -> Floats:
        """Return all parameters in one vector."""
        return np.concatenate(
            [self.turns.ravel(), self.log_scales, self.modes.ravel(), self.extent, self.play, self.logs]
        )

    @classmethod
    def unflat(cls, flat: Floats, frames: int) -> Motion:
        """Return the parameters of a vector made by `flat`."""
        modes = flat[4 * frames : -14]
        return cls(
            flat[: 3 * frames].reshape(frames, 3), flat[3 * frames : 4 * frames], modes.reshape(frames, -1),
            flat[-14:-8], flat[-8:-2], flat[-2:],
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What the likelihood is asked about."""

    gram: Floats
    """W Wᵀ / P of centred, complete tracks, normalised units, shape `(2F, 2F)`."""

    rotations: Floats
    """The cameras at zero turn, shape `(F, 3, 3)`."""

    with_scales: bool
    """False: every s_f is 1."""

    walk: Floats
    """T, shape `(F, F)`, mean of the diagonal 1."""

    steadiness: float
    """Weight of the camera's unsteadiness."""

    noise_floor: float
    """Normalised units; added to σ in quadrature."""

    smoothness: float = SMOOTHNESS
    """κ."""

    @classmethod
    def of(
        cls,
        gram: Floats,
        rotations: Floats,
        *,
        with_scales: bool,
        steadiness: float = STEADINESS,
        noise_floor: float = NOISE_FLOOR,
    ) -> Scene:
        """Return the scene for a Gram matrix and starting cameras."""
        frames = len(rotations)
        steps = np.diff(np.eye(frames), axis=0)
        walk = np.linalg.inv(steps.T @ steps + np.eye(frames) * 10.0 / frames**2)
        return cls(gram, rotations, with_scales, walk / (np.trace(walk) / frames), steadiness, noise_floor)


def start(scene: Scene, scales: Floats, *, num_modes: int = NUM_MODES) -> Motion:
    """Return a rigid explanation and, from what it leaves, the leading modes in time."""
    frames = len(scene.rotations)
    rows = (scene.rotations[:, :2] * scales[:, None, None]).reshape(2 * frames, 3)
    inverse = np.linalg.pinv(rows)
    extent = inverse @ scene.gram @ inverse.T
    extent = extent + 1e-3 * np.trace(extent) / 3 * np.eye(3)
    rest = np.eye(2 * frames) - rows @ inverse
    left = rest @ scene.gram @ rest.T
    variance = max(float(np.trace(left)) / (2 * frames), scene.noise_floor**2)
    values, vectors = np.linalg.eigh((left[0::2, 0::2] + left[1::2, 1::2]) / 2)
    count = min(num_modes, frames // 2)
    modes = vectors[:, ::-1][:, :count] * np.sqrt(np.maximum(values[::-1][:count], 1e-12))
    return Motion(
        np.zeros((frames, 3)), np.log(scales), modes, root_of(extent), np.eye(3)[LOWER],
        0.5 * np.log(variance * np.array([0.05, 0.2])),
    )  # fmt: skip


class Moved(Protocol):
    """Parameters that move cameras."""

    @property
    def turns(self) -> Floats:
        """Rotation vectors, shape `(F, 3)`."""

    @property
    def log_scales(self) -> Floats:
        """Shape `(F,)`."""


def cameras_of(scene: Scene, motion: Moved) -> tuple[Floats, Floats]:
    """Return rotations (F, 3, 3) and scales (F,), mean logarithm 0."""
    rotations = exponential(motion.turns) @ scene.rotations
    logs = motion.log_scales - motion.log_scales.mean() if scene.with_scales else np.zeros(len(rotations))
    return rotations, np.exp(logs)


def covariances_of(scene: Scene, motion: Motion) -> tuple[Floats, Floats, float, float]:
    """Return A₀, A₁, σ², the scene's floor included, and τ."""
    root0, root1 = _root(motion.extent), _root(motion.play)
    noise, drift = np.exp(2 * motion.logs)
    return root0 @ root0.T, root1 @ root1.T, float(noise) + scene.noise_floor**2, float(drift)


@np.errstate(over="ignore", invalid="ignore")  # a line search may try a step far too long: that energy is `UNLIKELY`
def energy_with_inverse(scene: Scene, motion: Motion) -> tuple[float, Motion, Floats | None]:
    """Return E with the penalties on modes, turns and scales, its gradient, analytic in every parameter, and M⁻¹.

    M⁻¹ is None where M is not positive definite. ∂E/∂G = M⁻¹/2F.

    With D = ∂E/∂M = (M⁻¹ − M⁻¹ G M⁻¹)/2F, everything follows from D and the blocks of M. Turns move on SO(3)^F by the
    exponential map, whose left Jacobian carries the gradient from the rotation to its vector.
    """
    frames = len(scene.rotations)
    rotations, scales = cameras_of(scene, motion)
    pairs = rotations[:, :2] * scales[:, None, None]
    rows = pairs.reshape(2 * frames, 3)
    root0, root1 = _root(motion.extent), _root(motion.play)
    rows0, rows1 = rows @ (root0 @ root0.T), rows @ (root1 @ root1.T)
    noise, drift = np.exp(2 * motion.logs)
    wide = np.repeat(np.repeat(motion.modes @ motion.modes.T + drift * scene.walk, 2, axis=0), 2, axis=1)
    deform = rows1 @ rows.T
    covariance = rows0 @ rows.T + deform * wide
    covariance[np.diag_indices(2 * frames)] += noise + scene.noise_floor**2
    inverse, log_det = inverted(covariance)
    if inverse is None or not np.isfinite(log_det):
        return UNLIKELY, Motion.unflat(np.zeros_like(motion.flat()), frames), None
    explained = inverse @ scene.gram
    value = 0.5 * (log_det + float(np.trace(explained))) / frames
    slope = 0.5 * (inverse - explained @ inverse) / frames
    slope = (slope + slope.T) / 2
    widened = slope * wide
    by_pairs = 2 * (slope @ rows0 + widened @ rows1).reshape(frames, 2, 3)
    by_frames = (slope * deform).reshape(frames, 2, frames, 2).sum(axis=(1, 3))
    rough, by_modes = _roughness(motion.modes, scene.smoothness / frames)
    uneven, by_logs = unevenness(np.log(scales))
    by_logs = scene.steadiness * by_logs + np.einsum("fij,fij->f", by_pairs, pairs)
    unsteady, by_rotations = unsteadiness(rotations)
    by_rotations *= scene.steadiness
    by_rotations[:, :2] += by_pairs * scales[:, None, None]
    turned = vee(by_rotations @ np.swapaxes(rotations, 1, 2))
    gradient = Motion(
        np.einsum("fji,fj->fi", left_jacobian(motion.turns), turned),
        (by_logs - by_logs.mean()) * scene.with_scales,
        by_modes + 2 * by_frames @ motion.modes,
        2 * (rows.T @ slope @ rows @ root0)[LOWER],
        2 * (rows.T @ widened @ rows @ root1)[LOWER],
        2 * np.array([np.trace(slope) * noise, (by_frames * scene.walk).sum() * drift]),
    )
    return value + rough + scene.steadiness * (uneven + unsteady), gradient, inverse


def energy(scene: Scene, motion: Motion) -> tuple[float, Motion]:
    """Return E and its gradient."""
    value, gradient, _ = energy_with_inverse(scene, motion)
    return value, gradient


def fit(scene: Scene, motion: Motion, *, iterations: int, turning: bool) -> tuple[Motion, float]:
    """Return the parameters that minimise the energy from `motion` on, by L-BFGS, and the energy reached.

    With `turning` False the rotations stay; everything else, scales included, is fitted.
    """
    frames = len(scene.rotations)
    held = 0 if turning else 3 * frames
    given = motion.flat()

    def objective(free: Floats) -> tuple[float, Floats]:
        value, gradient = energy(scene, Motion.unflat(np.concatenate([given[:held], free]), frames))
        return value, gradient.flat()[held:]

    found = minimize(
        objective, given[held:], jac=True, method="L-BFGS-B", options={"maxiter": iterations, "maxcor": 20}
    )
    return Motion.unflat(np.concatenate([given[:held], np.asarray(found.x)]), frames), float(found.fun)


def root_of(matrix: Floats) -> Floats:
    """Return the lower triangle of a root of a covariance, shape `(6,)`; one without extent along an axis gets hardly any."""
    return root_matrix(matrix)[LOWER]


def root_matrix(matrix: Floats) -> Floats:
    """Return the same as a lower triangular matrix, shape `(3, 3)`."""
    try:
        return np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        values = np.maximum(values, max(1e-9 * float(values[-1]), 1e-12))
        return np.asarray(np.linalg.cholesky((vectors * values) @ vectors.T), dtype=np.float64)


def _root(lower: Floats) -> Floats:
    root = np.zeros((3, 3))
    root[LOWER] = lower
    return root


def _roughness(values: Floats, weight: float) -> tuple[float, Floats]:
    """Return weight/2 ‖H x‖² and its gradient, H the first difference over frames."""
    steps = np.diff(values, axis=0)
    gradient = np.zeros_like(values)
    gradient[1:] += weight * steps
    gradient[:-1] -= weight * steps
    return 0.5 * weight * float((steps**2).sum()), gradient


def inverted(matrix: Floats) -> tuple[Floats | None, float]:
    """Return inverse and log-determinant of a positive definite matrix, or None where rounding left it indefinite."""
    factor, failed = lapack.dpotrf(matrix, lower=1)
    if failed:
        return None, np.inf
    log_det = 2 * float(np.log(np.diag(factor)).sum())
    inverse = np.asarray(lapack.dpotri(factor, lower=1)[0])
    return np.asarray(np.tril(inverse) + np.tril(inverse, -1).T), log_det

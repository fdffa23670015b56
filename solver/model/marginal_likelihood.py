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

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from pliant.solver.model.camera_motion_prior import unevenness, unsteadiness
from pliant.solver.model.image_density import ImageModel, factor_of, inverted, terms
from pliant.solver.model.so3 import exponential, left_jacobian, vee
from pliant.solver.records import Floats
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

    steadiness: float
    """Weight of the camera's unsteadiness."""

    noise_floor: float
    """Normalised units; added to σ in quadrature."""

    smoothness: float = SMOOTHNESS
    """κ."""

    factor: Floats = field(init=False)
    """F₀ with F₀F₀ᵀ = G, shape `(2F, r)`."""

    def __post_init__(self) -> None:
        """Factor the Gram matrix."""
        object.__setattr__(self, "factor", factor_of(self.gram))

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
        return cls(gram, rotations, with_scales, steadiness, noise_floor)


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


def image_of(scene: Scene, motion: Motion) -> ImageModel:
    """Return the covariance of the images, by its parts."""
    rotations, scales = cameras_of(scene, motion)
    pairs = rotations[:, :2] * scales[:, None, None]
    root0, root1 = _root(motion.extent), _root(motion.play)
    noise, drift = np.exp(2 * motion.logs)
    walk = pairs @ root1
    columns = np.concatenate([(pairs @ root0)[:, :, None], motion.modes[:, None, :, None] * walk[:, :, None]], axis=2)
    return ImageModel(columns.reshape(2 * len(pairs), -1), walk, float(noise) + scene.noise_floor**2, float(drift))


def energy_with_inverse(scene: Scene, motion: Motion) -> tuple[float, Motion, Floats | None]:
    """Return E, its gradient and M⁻¹, shape `(2F, 2F)`, for ∂E/∂G = M⁻¹/2F; None where M is not positive definite."""
    value, gradient = energy(scene, motion)
    if value == UNLIKELY:
        return value, gradient, None
    return value, gradient, inverted(image_of(scene, motion).covariance())[0]


# A line search may try a step far too long: that energy is `UNLIKELY`.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def energy(scene: Scene, motion: Motion) -> tuple[float, Motion]:
    """Return E with the penalties on modes, turns and scales, and its gradient, analytic in every parameter.

    With s_f R_f as Π_f and B_f = Π_f A₁^½, the columns of the image are Π_f A₀^½ and l_fk B_f (`model.image_density`). Turns move on
    SO(3)^F by the exponential map, whose left Jacobian carries the gradient from the rotation to its vector.
    """
    frames = len(scene.rotations)
    rotations, scales = cameras_of(scene, motion)
    pairs = rotations[:, :2] * scales[:, None, None]
    root0, root1 = _root(motion.extent), _root(motion.play)
    noise, drift = np.exp(2 * motion.logs)
    try:
        model = image_of(scene, motion)
        found = terms(model, scene.factor)
    except np.linalg.LinAlgError:
        return UNLIKELY, Motion.unflat(np.zeros_like(motion.flat()), frames)
    by_columns = found.by_columns.reshape(frames, 2, -1, 3)
    by_walk = found.by_walk + np.einsum("fk,fikc->fic", motion.modes, by_columns[:, :, 1:])
    by_pairs = by_columns[:, :, 0] @ root0.T + by_walk @ root1.T
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
        by_modes + np.einsum("fikc,fic->fk", by_columns[:, :, 1:], model.walk),
        np.einsum("fic,fid->cd", pairs, by_columns[:, :, 0])[LOWER],
        np.einsum("fic,fid->cd", pairs, by_walk)[LOWER],
        2 * np.array([found.by_noise * noise, found.by_drift * drift]),
    )
    return found.value + rough + scene.steadiness * (uneven + unsteady), gradient


def fit(
    scene: Scene, motion: Motion, *, iterations: int, turning: bool, should_stop: Callable[[], bool] | None = None
) -> tuple[Motion, float]:
    """Return the parameters that minimise the energy from `motion` on, by L-BFGS, and the energy reached.

    With `turning` False the rotations stay; everything else, scales included, is fitted. Once `should_stop`, called after every
    iteration, returns True, the parameters reached are returned.
    """
    frames = len(scene.rotations)
    held = 0 if turning else 3 * frames
    given = motion.flat()

    def objective(free: Floats) -> tuple[float, Floats]:
        value, gradient = energy(scene, Motion.unflat(np.concatenate([given[:held], free]), frames))
        return value, gradient.flat()[held:]

    def asked(xk: Floats) -> None:  # noqa: ARG001 - SciPy calls it by this name
        if should_stop is not None and should_stop():
            raise StopIteration

    found = minimize(
        objective, given[held:], jac=True, method="L-BFGS-B", callback=asked,
        options={"maxiter": iterations, "maxcor": 20},
    )  # fmt: skip
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

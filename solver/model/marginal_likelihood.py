"""Negative log likelihood of the tracks given cameras, with the shapes integrated out.

The world positions of a point over all frames are Gaussian: a mean position with covariance A₀ (3×3) plus a
deformation with covariance C (F×F) over frames and A₁ over axes. The image positions then have the covariance

    M = σ² I + Π (1 1ᵀ ⊗ A₀ + C ⊗ A₁) Πᵀ,    Π = blockdiag(s_f R_f),    C = L Lᵀ + τ T,

and with G = W Wᵀ / P the negative log likelihood per point and frame is, up to a constant,

    E = (log det M + tr M⁻¹ G) / 2F.

The trace is variable projection: tr M⁻¹ G is the minimum over S of ‖W − Π S‖²/σ² + ‖S‖²_prior. On its own it falls
when depth is traded for rotation, because a flatter shape that rotates more moves the same way in the image. The
log-determinant counteracts this: a prior with less depth explains less. T is the covariance of a random walk; the
modes L (F×q) are the low-rank part. The penalty κ‖H L‖²/2F keeps them smooth, because otherwise every frame is
rotated to fit the mean shape. `model.camera_motion_prior` adds the penalty on the cameras. The tracks enter only
through G, so the cost does not depend on P.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from pliant.solver.model.camera_motion_prior import STEADY, rotation_roughness, scale_roughness
from pliant.solver.model.frame_metric import FrameMetric
from pliant.solver.model.image_density import ImageModel, Terms, factor_of, inverted, terms
from pliant.solver.model.lbfgs import minimize
from pliant.solver.model.so3 import exponential_and_jacobian, vee
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, projections_of

NOISE_STD_FLOOR = 3e-3
"""Floor of the noise standard deviation, normalized units: no tracks of real video are better. A smaller floor spends
modes on model error and slows L-BFGS."""

CAMERA_PRIOR_WEIGHT = 0.05
"""Weight of `model.camera_motion_prior`, one term per camera, relative to E, one term per point: points of a surface
move together and count as about 1/0.05 independent ones."""

SMOOTHNESS = 1000.0
"""κ, weight of the penalty on differences of the modes between frames."""

NUM_MODES = 16
"""q, number of modes."""

UNLIKELY = 1e6
"""Energy returned where M is not numerically positive definite; the line search steps back from it."""

MAX_LOG_SCALE = 100.0
"""Bound on |log s_f|, far beyond any camera: without a prior nothing bounds the scale of a frame whose points coincide."""

LOWER = np.tril_indices(3)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Parameters of the density; a gradient has the same fields."""

    turns: Floats
    """Rotation vectors relative to the starting cameras: R_f = exp(turns_f) R_f⁰, shape `(F, 3)`."""

    log_scales: Floats
    """Shape `(F,)`; only differences from the mean matter."""

    modes: Floats
    """L, shape `(F, q)`."""

    mean_root: Floats
    """Lower triangle of a root of A₀, shape `(6,)`."""

    axis_root: Floats
    """Lower triangle of a root of A₁, shape `(6,)`."""

    logs: Floats
    """log σ and ½ log τ, shape `(2,)`."""

    def flat(self) -> Floats:
        """Return all parameters in one vector; those of frames first, as an array of shape `(4 + q, F)`."""
        return np.concatenate(
            [self.turns.T.ravel(), self.log_scales, self.modes.T.ravel(), self.mean_root, self.axis_root, self.logs]
        )

    @classmethod
    def unflat(cls, flat: Floats, frames: int) -> Motion:
        """Return the parameters of a vector made by `flat`."""
        over_frames = flat[:-14].reshape(-1, frames)
        return cls(over_frames[:3].T, over_frames[3], over_frames[4:].T, flat[-14:-8], flat[-8:-2], flat[-2:])


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The data and settings of the likelihood."""

    gram: Floats
    """G = W Wᵀ / P of centred, complete tracks, normalized units, shape `(2F, 2F)`; empty where `factor` is given."""

    rotations: Floats
    """The cameras at zero turn, shape `(F, 3, 3)`."""

    with_scales: bool
    """Whether scales are free; otherwise every s_f is 1."""

    prior_weight: float
    """Weight of the camera-motion prior."""

    noise_std_floor: float
    """Floor of the noise standard deviation, normalized units; added to σ in quadrature."""

    smoothness: float = SMOOTHNESS
    """κ."""

    ordered: bool = True
    """Whether T is a random walk over frames; otherwise it is the identity."""

    factor: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """F₀ with F₀F₀ᵀ = G, shape `(2F, r)`; computed from `gram` unless given, as for films whose Gram matrix would be too large."""

    def __post_init__(self) -> None:
        """Factor the Gram matrix."""
        if len(self.factor) == 0:
            object.__setattr__(self, "factor", factor_of(self.gram))

    @classmethod
    def of(
        cls,
        gram: Floats,
        rotations: Floats,
        *,
        with_scales: bool,
        prior_weight: float = CAMERA_PRIOR_WEIGHT,
        noise_std_floor: float = NOISE_STD_FLOOR,
        ordered: bool = True,
    ) -> Scene:
        """Return the scene for a Gram matrix and starting cameras; if unordered, without penalties on differences between frames."""
        if not ordered:
            return cls(gram, rotations, with_scales, 0.0, noise_std_floor, 0.0, ordered=False)
        return cls(gram, rotations, with_scales, prior_weight, noise_std_floor)


def start(scene: Scene, scales: Floats, *, num_modes: int = NUM_MODES) -> Motion:
    """Return starting parameters: a rigid shape and, from its residual, the leading modes over time."""
    frames = len(scene.rotations)
    rows = projections_of(scene.rotations, scales).reshape(2 * frames, 3)
    inverse = np.linalg.pinv(rows)
    mean_covariance = inverse @ scene.gram @ inverse.T
    mean_covariance = mean_covariance + 1e-3 * np.trace(mean_covariance) / 3 * np.eye(3)
    rest = np.eye(2 * frames) - rows @ inverse
    left = rest @ scene.gram @ rest.T
    variance = max(float(np.trace(left)) / (2 * frames), scene.noise_std_floor**2)
    values, vectors = np.linalg.eigh((left[0::2, 0::2] + left[1::2, 1::2]) / 2)
    count = min(num_modes, frames // 2)
    modes = vectors[:, ::-1][:, :count] * np.sqrt(np.maximum(values[::-1][:count], 1e-12))
    return Motion(
        np.zeros((frames, 3)), np.log(scales), modes, root_of(mean_covariance), np.eye(3)[LOWER],
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
    rotations, scales, _ = cameras_and_jacobian(scene, motion)
    return rotations, scales


def cameras_and_jacobian(scene: Scene, motion: Moved) -> tuple[Floats, Floats, Floats]:
    """Return rotations (F, 3, 3), scales (F,), and the left Jacobians of the turns, shape `(F, 3, 3)`."""
    turned, jacobian = exponential_and_jacobian(motion.turns)
    rotations = turned @ scene.rotations
    if not scene.with_scales:
        return rotations, np.ones(len(turned)), jacobian
    logs = motion.log_scales - motion.log_scales.mean()
    return rotations, np.exp(logs.clip(-MAX_LOG_SCALE, MAX_LOG_SCALE)), jacobian


def covariances_of(scene: Scene, motion: Motion) -> tuple[Floats, Floats, float, float]:
    """Return A₀, A₁, σ² including the scene's floor, and τ."""
    root0, root1, noise, walk_variance = _shared(motion)
    return root0 @ root0.T, root1 @ root1.T, noise + scene.noise_std_floor**2, walk_variance


def image_of(scene: Scene, motion: Motion) -> ImageModel:
    """Return the covariance of the images in factored form."""
    rotations, scales = cameras_of(scene, motion)
    return _image(scene, motion.modes, projections_of(rotations, scales), *_shared(motion))


def _image(
    scene: Scene, modes: Floats, projections: Floats, root0: Floats, root1: Floats, noise: float, walk_variance: float
) -> ImageModel:
    rows = projections.reshape(-1, 3)
    walk = (rows @ root1).reshape(projections.shape)
    deformed = (modes[:, None, :, None] * walk[:, :, None]).reshape(len(rows), -1)
    columns = np.concatenate([rows @ root0, deformed], axis=1)
    return ImageModel(columns, walk, noise + scene.noise_std_floor**2, walk_variance, scene.ordered)


def energy(scene: Scene, motion: Motion) -> tuple[float, Motion]:
    """Return E with the penalties on modes, rotations and scales, and its gradient, analytic in every parameter.

    With Π_f = s_f R_f and B_f = Π_f A₁^½, the columns of the image are Π_f A₀^½ and l_fk B_f (`model.image_density`).
    Rotations move on SO(3)^F by the exponential map, whose left Jacobian maps the gradient from the rotation to its
    vector.
    """
    value, gradient, _ = _energy(scene, motion)
    return value, gradient


def energy_with_inverse(scene: Scene, motion: Motion) -> tuple[float, Motion, Floats | None]:
    """Return E, its gradient and M⁻¹, shape `(2F, 2F)`, for ∂E/∂G = M⁻¹/2F; None where M is not positive definite."""
    value, gradient, found = _energy(scene, motion)
    if found is None:
        return value, gradient, None
    inverse = found.inverse
    return value, gradient, inverted(image_of(scene, motion).covariance())[0] if inverse is None else inverse


# A line search may try a step that overflows: its energy is then `UNLIKELY`.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _energy(scene: Scene, motion: Motion) -> tuple[float, Motion, Terms | None]:
    """Return E, its gradient, and the terms of the density; no terms where M is not positive definite."""
    frames = len(scene.rotations)
    rotations, scales, jacobian = cameras_and_jacobian(scene, motion)
    projections = projections_of(rotations, scales)
    root0, root1, noise, walk_variance = _shared(motion)
    try:
        if walk_variance == 0:  # underflow
            raise np.linalg.LinAlgError("no random walk is left")
        model = _image(scene, motion.modes, projections, root0, root1, noise, walk_variance)
        found = terms(model, scene.factor)
    except np.linalg.LinAlgError:
        return UNLIKELY, Motion.unflat(np.zeros_like(motion.flat()), frames), None
    by_mean, rows = found.by_columns[:, :3], projections.reshape(-1, 3)
    # By the images of each mode in each frame. Products of matrices take half the time of `einsum`, which matters for short films.
    by_images = found.by_columns[:, 3:].reshape(frames, 2, -1, 3).transpose(0, 2, 1, 3).reshape(frames, -1, 6)
    by_walk = (found.by_walk.reshape(frames, 1, 6) + motion.modes[:, None] @ by_images).reshape(-1, 3)
    by_projections = (by_mean @ root0.T + by_walk @ root1.T).reshape(projections.shape)
    rough, by_modes = _roughness(motion.modes, scene.smoothness / frames)
    rough_cameras, by_rotations, by_logs = _camera_roughness(scene, rotations, scales)
    if scene.with_scales:
        by_logs += (by_projections * projections).sum(axis=(1, 2))
        by_logs -= by_logs.sum() / frames
    by_rotations[:, :2] += by_projections * scales[:, None, None]
    turned = vee(by_rotations @ rotations.transpose(0, 2, 1))
    gradient = Motion(
        (turned[:, None] @ jacobian)[:, 0],
        by_logs,
        by_modes + (by_images @ model.walk.reshape(frames, 6, 1))[:, :, 0],
        (rows.T @ by_mean)[LOWER],
        (rows.T @ by_walk)[LOWER],
        np.array([2 * found.by_noise_variance * noise, 2 * found.by_walk_variance * walk_variance]),
    )
    return found.value + rough + rough_cameras, gradient, found


def fit(
    scene: Scene,
    motion: Motion,
    *,
    iterations: int,
    turning: bool,
    metric: FrameMetric | None = None,
    should_stop: ShouldStop = never,
) -> tuple[Motion, float]:
    """Return the parameters that minimise the energy, by L-BFGS from `motion`, and the energy reached.

    With `turning` False the rotations stay fixed; everything else, including scales, is fitted. With a `metric`, steps are
    taken in its coordinates over the frames. `should_stop` is called after every iteration; once it returns True, the
    parameters reached so far are returned.
    """
    frames = len(scene.rotations)
    held = 0 if turning else 3 * frames
    # The metric belongs to the likelihood of all frames; the energy is per frame.
    factor = 1 if metric is None else frames
    given = motion.flat() if metric is None else _over_frames(metric.coordinates, motion.flat(), frames)

    def parameters(free: Floats) -> Motion:
        reached = np.concatenate([given[:held], free])
        return Motion.unflat(reached if metric is None else _over_frames(metric.parameters, reached, frames), frames)

    def objective(free: Floats) -> tuple[float, Floats]:
        value, gradient = energy(scene, parameters(free))
        slope = gradient.flat() if metric is None else _over_frames(metric.gradient, gradient.flat(), frames)
        return factor * value, factor * slope[held:]

    free, value = minimize(objective, given[held:], maxiter=iterations, should_stop=should_stop)
    return parameters(free), value / factor


def metric_of(scene: Scene, motion: Motion) -> FrameMetric:
    """Return the metric of the likelihood at these parameters, for `fit`."""
    _, _, noise, walk_variance = _shared(motion)
    noise += scene.noise_std_floor**2
    return FrameMetric.of(motion.modes, noise_variance=noise, walk_variance=walk_variance, ordered=scene.ordered)


def _over_frames(change: Callable[[Floats], Floats], flat: Floats, frames: int) -> Floats:
    """Apply `change` over the frames to turns, scales and modes, of parameters or of a gradient, in a vector made by `Motion.flat`."""
    return np.concatenate([change(flat[:-14].reshape(-1, frames).T).T.ravel(), flat[-14:]])


def root_of(matrix: Floats) -> Floats:
    """Return the lower triangle of a root of a covariance, shape `(6,)`; singular covariances are regularised."""
    return root_matrix(matrix)[LOWER]


def root_matrix(matrix: Floats) -> Floats:
    """Return a lower triangular root of a covariance, shape `(3, 3)`; singular covariances are regularised."""
    try:
        return np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        values = np.maximum(values, max(1e-9 * float(values[-1]), 1e-12))
        return np.asarray(np.linalg.cholesky((vectors * values) @ vectors.T), dtype=np.float64)


def _shared(motion: Motion) -> tuple[Floats, Floats, float, float]:
    """Return what all frames share: roots of A₀ and A₁, σ² without the scene's floor, and τ."""
    root0, root1 = np.zeros((2, 3, 3))
    root0[LOWER], root1[LOWER] = motion.mean_root, motion.axis_root
    noise, walk_variance = np.exp(2 * motion.logs).tolist()
    return root0, root1, noise, walk_variance


def _camera_roughness(scene: Scene, rotations: Floats, scales: Floats) -> tuple[float, Floats, Floats]:
    """Return the weighted penalty on rotations and scales, and its gradients for rotations and logarithms of the scales."""
    weight, rough_scales, by_logs = scene.prior_weight, STEADY, np.zeros(scales.shape)
    if weight == 0:
        return 0.0, np.zeros(rotations.shape), by_logs
    if scene.with_scales:
        rough_scales, by_logs = scale_roughness(np.log(scales))
    rough_rotations, by_rotations = rotation_roughness(rotations)
    return weight * (rough_scales + rough_rotations), weight * by_rotations, weight * by_logs


def _roughness(values: Floats, weight: float) -> tuple[float, Floats]:
    """Return weight/2 ‖H x‖² and its gradient, H the first difference over frames."""
    if weight == 0:
        return 0.0, np.zeros(values.shape)
    steps = values[1:] - values[:-1]
    gradient = np.zeros(values.shape)
    gradient[1:] = steps
    gradient[:-1] -= steps
    return 0.5 * weight * float(np.vdot(steps, steps)), weight * gradient

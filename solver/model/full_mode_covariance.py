"""Cameras refined with a basis of shapes whose coefficients covary in full, for clean tracks.

The shape covariance (`model.shape_covariance`) gives every mode the same covariance over axes, C ⊗ A₁. Real modes move along axes of
their own: a jaw down, lips forward. Cameras that are wrong by a degree or two make them look alike, and with hardly any noise that is
worth more than the error. So once the cameras are nearly right, the world positions of a point are taken as

    x_f = Σ_k c_fk b_k + random walk,    b = (b_1 … b_K) ~ N(0, Ω),    Ω = M Mᵀ of 3K × 3K,

with the mean position among the b_k, the c_fk those of the modes and one column of ones; that is the basis of shapes of Bregler,
Hertzmann, Biermann (2000), "Recovering non-rigid 3D shape from image streams", its coefficients integrated out as by Torresani,
Hertzmann, Bregler (2008). The image of a point then covaries by V = B Ω Bᵀ + τ (T ⊗ A₁ seen) + σ²I, where row f of B is
s_f R_f (c_f ⊗ I), and cameras, c, M, σ and τ minimise (log det V + tr V⁻¹G) / 2F together. From a separable start this is a long
way: thousands of steps of L-BFGS, each in 2F dimensions.

Ω has so many entries that it needs many points and few modes, and where there is noise it learns the noise: `telling` says where
it is of use. Measured with all points seen, estimated cameras: faces of 99 frames .0154 → .0081, horse .0125 → .0047; and with noise
of .01 all the same faces .044 → .28, without the question.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pliant.solver.model.camera_motion_prior import unevenness, unsteadiness
from pliant.solver.model.image_density import ImageModel, terms
from pliant.solver.model.marginal_likelihood import UNLIKELY, Scene, cameras_of, root_matrix
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import left_jacobian, vee
from pliant.solver.records import Floats
from scipy.optimize import minimize

POINTS_PER_COEFFICIENT = 4
"""Points that each of the 3K coefficients needs."""

QUIET = 1e-3
"""Noise, normalised units, from which on the basis would learn the noise."""

STEPS, FRAME_STEPS, MOST_FRAMES = 2400, 240_000, 160
"""L-BFGS iterations at most, their product with the frames, and the frames beyond which the way is too long."""

FLAT = 1e-7
"""Share of the energy that one iteration must gain, or the refinement is at its end."""


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """Parameters of the density; a gradient has the same fields."""

    turns: Floats
    """Rotation vectors that turn the scene's cameras, shape `(F, 3)`."""

    log_scales: Floats
    """Shape `(F,)`; only their differences from the mean count."""

    weights: Floats
    """c, shape `(F, K)`."""

    root: Floats
    """M, shape `(3K, 3K)`."""

    logs: Floats
    """log σ and ½ log τ, shape `(2,)`."""

    def flat(self) -> Floats:
        """Return all parameters in one vector."""
        return np.concatenate([self.turns.ravel(), self.log_scales, self.weights.ravel(), self.root.ravel(), self.logs])

    @classmethod
    def unflat(cls, flat: Floats, frames: int, size: int) -> Basis:
        """Return the parameters of a vector made by `flat` for `size` shapes."""
        turns, log_scales, weights, root, logs = np.split(
            flat, np.cumsum([3 * frames, frames, frames * size, 9 * size**2])
        )
        return cls(
            turns.reshape(frames, 3), log_scales, weights.reshape(frames, size), root.reshape(3 * size, -1), logs
        )


def telling(covariance: ShapeCovariance, points: int) -> bool:
    """Whether so many points tell how the coefficients of this covariance's modes covary."""
    frames, count = covariance.modes.shape
    size = 3 * (count + 1)
    return (
        frames <= MOST_FRAMES
        and covariance.noise < QUIET**2
        and size < 2 * frames
        and POINTS_PER_COEFFICIENT * size <= points
    )


def begin(scene: Scene, scales: Floats, covariance: ShapeCovariance) -> Basis:
    """Return the covariance as a basis: its modes and the mean, which do not covary."""
    frames = len(scene.rotations)
    weights = np.column_stack([covariance.modes, np.ones(frames)])
    root = np.kron(np.eye(weights.shape[1]), np.linalg.cholesky(covariance.play))
    root[-3:, -3:] = root_matrix(covariance.extent)
    noise = max(covariance.noise - scene.noise_floor**2, scene.noise_floor**4)
    return Basis(np.zeros((frames, 3)), np.log(scales), weights, root, 0.5 * np.log([noise, covariance.drift]))


# A line search may try a step far too long: that energy is `UNLIKELY`.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def energy(scene: Scene, play: Floats, basis: Basis) -> tuple[float, Basis]:
    """Return the energy with the terms for the camera's steadiness, and its gradient, analytic in every parameter.

    Parameters
    ----------
    scene : Scene
        Its smoothness does not count.
    play : array, shape (3, 3)
        A₁ of the random walk.
    basis : Basis
        Where.
    """
    frames, size = basis.weights.shape
    rotations, scales = cameras_of(scene, basis)
    pairs = rotations[:, :2] * scales[:, None, None]
    root = root_matrix(play)
    shapes = np.einsum("fk,fid->fikd", basis.weights, pairs).reshape(2 * frames, 3 * size)
    noise, drift = np.exp(2 * basis.logs)
    model = ImageModel(shapes @ basis.root, pairs @ root, float(noise) + scene.noise_floor**2, float(drift))
    try:
        found = terms(model, scene.factor)
    except np.linalg.LinAlgError:
        return UNLIKELY, Basis.unflat(np.zeros_like(basis.flat()), frames, size)
    by_shapes = (found.by_columns @ basis.root.T).reshape(frames, 2, size, 3)
    by_pairs = np.einsum("fikd,fk->fid", by_shapes, basis.weights) + found.by_walk @ root.T
    uneven, by_logs = unevenness(np.log(scales))
    by_logs = scene.steadiness * by_logs + np.einsum("fij,fij->f", by_pairs, pairs)
    unsteady, by_rotations = unsteadiness(rotations)
    by_rotations *= scene.steadiness
    by_rotations[:, :2] += by_pairs * scales[:, None, None]
    gradient = Basis(
        np.einsum("fji,fj->fi", left_jacobian(basis.turns), vee(by_rotations @ np.swapaxes(rotations, 1, 2))),
        (by_logs - by_logs.mean()) * scene.with_scales,
        np.einsum("fikd,fid->fk", by_shapes, pairs),
        shapes.T @ found.by_columns,
        2 * np.array([found.by_noise * noise, found.by_drift * drift]),
    )
    return found.value + scene.steadiness * (uneven + unsteady), gradient


def refined(
    scene: Scene,
    scales: Floats,
    covariance: ShapeCovariance,
    *,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[Floats, Floats]:
    """Return rotations (F, 3, 3) and scales (F,) that minimise the energy from the scene's on."""
    frames, size = len(scene.rotations), covariance.modes.shape[1] + 1
    start = begin(scene, scales, covariance)

    def objective(flat: Floats) -> tuple[float, Floats]:
        value, gradient = energy(scene, covariance.play, Basis.unflat(flat, frames, size))
        return value, gradient.flat()

    def asked(xk: Floats) -> None:  # noqa: ARG001 - SciPy calls it by this name
        if should_stop is not None and should_stop():
            raise StopIteration

    steps = min(STEPS, FRAME_STEPS // frames)
    found = minimize(
        objective, start.flat(), jac=True, method="L-BFGS-B", callback=asked,
        options={"maxiter": steps, "maxfun": 2 * steps, "maxcor": 20, "ftol": FLAT},
    )  # fmt: skip
    return cameras_of(scene, Basis.unflat(np.asarray(found.x), frames, size))

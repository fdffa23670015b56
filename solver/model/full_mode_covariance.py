"""Camera refinement with full covariance between mode coefficients, for clean tracks.

The shape covariance (`model.shape_covariance`) gives every mode the same covariance over axes, C ⊗ A₁. Real modes
move along axes of their own: a jaw down, lips forward. Camera errors of one or two degrees make these axes look
alike, and with little noise the separable model is then the larger error. Once the cameras are nearly right, the
world positions of a point are therefore modelled as

    x_f = Σ_k c_fk b_k + random walk,    b = (b_1 … b_K) ~ N(0, Ω),    Ω = M Mᵀ of 3K × 3K,

with the mean position among the b_k; the c_fk are the modes and one column of ones. This is the shape basis of
Bregler, Hertzmann, Biermann (2000), "Recovering non-rigid 3D shape from image streams", with coefficients integrated
out as in Torresani, Hertzmann, Bregler (2008). The image of a point has the covariance V = B Ω Bᵀ + τ (T ⊗ Π A₁ Πᵀ) +
σ²I, where row f of B is s_f R_f (c_f ⊗ I). Cameras, c, M, σ and τ minimise (log det V + tr V⁻¹G) / 2F jointly, by
L-BFGS from the separable model.

Ω has (3K)² entries, so it needs many points and few modes, and with noisy tracks it fits the noise. `is_identifiable`
decides whether it is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver.model.camera_motion_prior import rotation_roughness, scale_roughness
from pliant.solver.model.image_density import ImageModel, terms
from pliant.solver.model.lbfgs import minimize
from pliant.solver.model.marginal_likelihood import UNLIKELY, Scene, cameras_and_jacobian, cameras_of, root_matrix
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import vee
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats, projections_of

POINTS_PER_COEFFICIENT = 4
"""Minimum number of points for each of the 3K coefficients."""

MAX_NOISE_STD = 1e-3
"""Noise standard deviation, normalized units, above which the basis would fit noise and is not used: at .01 it raises
the error of faces from .044 to .28."""

MAX_STEPS, MAX_FRAME_STEPS, MAX_BASIS_FRAMES = 2400, 240_000, 160
"""Maximum L-BFGS iterations, maximum product of iterations and frames, and maximum number of frames: bounds on the
time."""

LBFGS_TOLERANCE = 1e-7
"""Relative decrease of the energy per iteration below which the refinement ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """Parameters of the density; a gradient has the same fields."""

    turns: Floats
    """Rotation vectors relative to the scene's cameras, shape `(F, 3)`."""

    log_scales: Floats
    """Shape `(F,)`; only differences from the mean matter."""

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


def is_identifiable(covariance: ShapeCovariance, points: int) -> bool:
    """Whether this number of points determines the covariance between the coefficients of the modes."""
    frames, count = covariance.modes.shape
    size = 3 * (count + 1)
    return (
        frames <= MAX_BASIS_FRAMES
        and covariance.noise_variance < MAX_NOISE_STD**2
        and size < 2 * frames
        and POINTS_PER_COEFFICIENT * size <= points
    )


def begin(scene: Scene, scales: Floats, covariance: ShapeCovariance) -> Basis:
    """Return the separable covariance as a basis: its modes and the mean, uncorrelated."""
    frames = len(scene.rotations)
    weights = np.column_stack([covariance.modes, np.ones(frames)])
    root = np.kron(np.eye(weights.shape[1]), np.linalg.cholesky(covariance.axis_covariance))
    root[-3:, -3:] = root_matrix(covariance.mean_covariance)
    noise = max(covariance.noise_variance - scene.noise_std_floor**2, scene.noise_std_floor**4)
    return Basis(np.zeros((frames, 3)), np.log(scales), weights, root, 0.5 * np.log([noise, covariance.walk_variance]))


# A line search may try a step that overflows: its energy is then `UNLIKELY`.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def energy(scene: Scene, axis_covariance: Floats, basis: Basis) -> tuple[float, Basis]:
    """Return the energy with the camera-motion prior, and its gradient, analytic in every parameter.

    Parameters
    ----------
    scene : Scene
        Its `smoothness` is ignored.
    axis_covariance : array, shape (3, 3)
        A₁ of the random walk.
    basis : Basis
        Parameters at which the energy is evaluated.
    """
    frames, size = basis.weights.shape
    rotations, scales, jacobian = cameras_and_jacobian(scene, basis)
    projections = projections_of(rotations, scales)
    root = root_matrix(axis_covariance)
    shapes = np.einsum("fk,fid->fikd", basis.weights, projections).reshape(2 * frames, 3 * size)
    noise, walk_variance = np.exp(2 * basis.logs)
    model = ImageModel(
        shapes @ basis.root, projections @ root, float(noise) + scene.noise_std_floor**2, float(walk_variance),
        scene.ordered,
    )  # fmt: skip
    try:
        found = terms(model, scene.factor)
    except np.linalg.LinAlgError:
        return UNLIKELY, Basis.unflat(np.zeros_like(basis.flat()), frames, size)
    by_shapes = (found.by_columns @ basis.root.T).reshape(frames, 2, size, 3)
    by_projections = np.einsum("fikd,fk->fid", by_shapes, basis.weights) + found.by_walk @ root.T
    rough_scales, by_logs = scale_roughness(np.log(scales))
    by_logs = scene.prior_weight * by_logs + np.einsum("fij,fij->f", by_projections, projections)
    rough_rotations, by_rotations = rotation_roughness(rotations)
    by_rotations *= scene.prior_weight
    by_rotations[:, :2] += by_projections * scales[:, None, None]
    gradient = Basis(
        np.einsum("fji,fj->fi", jacobian, vee(by_rotations @ np.swapaxes(rotations, 1, 2))),
        (by_logs - by_logs.mean()) * scene.with_scales,
        np.einsum("fikd,fid->fk", by_shapes, projections),
        shapes.T @ found.by_columns,
        2 * np.array([found.by_noise_variance * noise, found.by_walk_variance * walk_variance]),
    )
    return found.value + scene.prior_weight * (rough_scales + rough_rotations), gradient


def refined(
    scene: Scene,
    scales: Floats,
    covariance: ShapeCovariance,
    *,
    should_stop: ShouldStop = never,
) -> tuple[Floats, Floats]:
    """Return rotations (F, 3, 3) and scales (F,) that minimise the energy, starting from the scene's cameras."""
    frames, size = len(scene.rotations), covariance.modes.shape[1] + 1
    start = begin(scene, scales, covariance)

    def objective(flat: Floats) -> tuple[float, Floats]:
        value, gradient = energy(scene, covariance.axis_covariance, Basis.unflat(flat, frames, size))
        return value, gradient.flat()

    steps = min(MAX_STEPS, MAX_FRAME_STEPS // frames)
    flat, _ = minimize(
        objective, start.flat(), maxiter=steps, maxfun=2 * steps, ftol=LBFGS_TOLERANCE, should_stop=should_stop
    )
    return cameras_of(scene, Basis.unflat(flat, frames, size))

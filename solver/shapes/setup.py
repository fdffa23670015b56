"""Build the energy from normalized tracks, cameras, mesh and settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.energy.hyperparameters import bending_weight, choose_weights
from pliant.solver.energy.problem import Problem
from pliant.solver.mesh import Mesh
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.operators.finite_differences import difference_bands
from pliant.solver.operators.mesh_laplacian import Laplacian, build_laplacian
from pliant.solver.records import Choices
from pliant.solver.settings import Settings
from pliant.solver.shapes.irls import init
from pliant.solver.shapes.state import State
from pliant.solver.tracks.normalization import Normalized


def build_problem(
    normalized: Normalized,
    estimate: CameraEstimate,
    mesh: Mesh | None,
    settings: Settings,
    covariance: ShapeCovariance | None = None,
) -> tuple[Problem, Choices]:
    """Return the energy and the values chosen for automatic settings; a covariance makes the prior Gaussian."""
    # The Gaussian prior is a small difference of large numbers: too small for single precision in stiff fits.
    kind = np.dtype(settings.precision if covariance is None else "float64")
    laplacian = _laplacian(normalized, mesh, settings)
    weights, noise, reasons = choose_weights(normalized, covariance, laplacian, settings)
    frames = len(normalized.points)
    bands = weights.temporal * difference_bands(frames, weights.order)
    axes, quadratic = np.eye(3), None
    if covariance is not None:
        axes, precisions = covariance.precisions()
        bands, quadratic = np.zeros_like(bands), precisions.scaled(weights.temporal)
    projections = estimate.projections @ axes
    problem = Problem(
        points=np.ascontiguousarray(normalized.points.transpose(0, 2, 1), dtype=kind),
        confidence=normalized.visible.astype(kind),
        projections=np.ascontiguousarray(projections, dtype=kind),
        loss=settings.loss if settings.method == "robust" else "l2",
        weights=weights,
        bands=bands,
        laplacian=laplacian if weights.spatial > 0 or covariance is not None else None,
        axes=axes,
        quadratic=quadratic,
    )
    choices = Choices(
        basis_size=estimate.basis_size, temporal_weight=weights.temporal, spatial_weight=weights.spatial,
        robust_scale=weights.robust_scale, temporal_order=weights.order, low_rank_weight=weights.low_rank,
        laplacian=laplacian.name if laplacian is not None else "none", unit=normalized.unit, noise=noise * normalized.unit,
        reasons={**estimate.reasons, **reasons}, warnings=estimate.warnings,
    )  # fmt: skip
    return problem, choices


def with_bending(
    problem: Problem,
    choices: Choices,
    state: State,
    settings: Settings,
    *,
    bending: float | None,
    bends: NDArray[np.bool_] | None = None,
) -> tuple[Problem, Choices, State]:
    """Set λ2 if it is automatic and the prior is Gaussian: to `bending`, or from the current shapes of the points `bends` if None."""
    if problem.quadratic is None or problem.laplacian is None or settings.spatial_weight is not None:
        return problem, choices, state
    modes = problem.quadratic.modes[0].shape[1]
    if bending is None:
        weight = bending_weight(problem.weights.temporal, problem.laplacian, state.shapes, modes, bends=bends)
    else:
        weight = bending
    problem = replace(problem, weights=replace(problem.weights, spatial=weight))
    reason = f"{choices.reasons['weights']} λ2 = {weight:.2g} from the bending of the surface."
    choices = replace(choices, spatial_weight=weight, reasons={**choices.reasons, "weights": reason})
    return problem, choices, init(problem, state.shapes, state.translations)


def _laplacian(normalized: Normalized, mesh: Mesh | None, settings: Settings) -> Laplacian | None:
    if settings.method in ("pseudo_inverse", "temporal"):
        return None
    return build_laplacian(mesh, settings.laplacian, _reference(normalized), seed=settings.seed)


def _reference(normalized: Normalized) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return each point's mean image position with depth 0, shape `(P, 3)`, the reference shape for cotangent weights."""
    total = np.maximum(normalized.visible.sum(axis=0), np.finfo(float).tiny)
    mean = np.einsum("fp,fpc->pc", normalized.visible, normalized.points) / total[:, None]
    return np.concatenate([mean, np.zeros((len(mean), 1))], axis=1)

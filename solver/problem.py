"""From normalised tracks, cameras, mesh and settings to the one energy that is minimised."""

from __future__ import annotations

import numpy as np
from pliant.solver.cameras import CameraEstimate
from pliant.solver.laplacian import Laplacian, build_laplacian
from pliant.solver.normalise import Normalised
from pliant.solver.records import Choices, Mesh
from pliant.solver.settings import Settings
from pliant.solver.state import Problem
from pliant.solver.temporal import difference_bands
from pliant.solver.weights import choose_weights


def build_problem(
    normalised: Normalised, estimate: CameraEstimate, mesh: Mesh | None, settings: Settings
) -> tuple[Problem, Choices]:
    """Choose what the settings leave open, and put the energy together."""
    kind = np.dtype(settings.precision)
    laplacian = _laplacian(normalised, mesh, settings)
    weights, noise, reasons = choose_weights(normalised, estimate, laplacian, settings)
    frames = len(normalised.points)
    projections = np.asarray(estimate.scales)[:, None, None] * np.asarray(estimate.rotations)[:, :2]
    problem = Problem(
        points=np.ascontiguousarray(normalised.points.transpose(0, 2, 1), dtype=kind),
        confidence=normalised.visible.astype(kind),
        projections=np.ascontiguousarray(projections, dtype=kind),
        loss=settings.loss if settings.method == "robust" else "l2",
        weights=weights,
        bands=weights.temporal * difference_bands(frames, weights.order),
        laplacian=laplacian if weights.spatial > 0 else None,
    )
    choices = Choices(
        basis_size=estimate.basis_size,
        temporal_weight=weights.temporal,
        spatial_weight=weights.spatial,
        robust_scale=weights.robust_scale,
        temporal_order=weights.order,
        low_rank_weight=weights.low_rank,
        laplacian=laplacian.name if laplacian is not None else "none",
        unit=normalised.unit,
        noise=noise * normalised.unit,
        reasons={**estimate.reasons, **reasons},
        warnings=tuple(estimate.warnings),
    )
    return problem, choices


def _laplacian(normalised: Normalised, mesh: Mesh | None, settings: Settings) -> Laplacian | None:
    if settings.method in ("pseudo_inverse", "temporal"):
        return None
    return build_laplacian(mesh, settings.laplacian, _reference(normalised))


def _reference(normalised: Normalised) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return each point's mean image position with depth 0, shape `(P, 3)`: geometry enough for cotangents."""
    total = np.maximum(normalised.visible.sum(axis=0), np.finfo(float).tiny)
    mean = np.einsum("fp,fpc->pc", normalised.visible, normalised.points) / total[:, None]
    return np.concatenate([mean, np.zeros((len(mean), 1))], axis=1)

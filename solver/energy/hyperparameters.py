"""λ1, λ2, λ3 and the robust scale: the paper's values, or values chosen from the data.

Near zero a robust loss is a parabola with curvature 1/ε, much steeper than a least-squares data term; far from zero
its slope is 1, so a point follows an outlier wherever bending its path costs less than the residual. At the paper's
λ1 = 1e-3, bending is nearly free and gross outliers are fitted. An outlier is resisted once λ1 ‖H S‖² of the jump
exceeds the jump itself; for jumps of one RMS radius, this requires λ1 well above 1. Exact data are still fitted
exactly, because the loss has slope 1 even for small residuals. λ2 must stay far below λ1: where the camera does not
determine depth, the two priors do, and a large λ2 flattens the surface. See `benchmarks/README.md` for measurements.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.energy.problem import Weights
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.operators.mesh_laplacian import Laplacian
from pliant.solver.settings import Settings
from pliant.solver.tracks.noise import magnified, weighted_median
from pliant.solver.tracks.normalization import Normalized

PAPER = Weights(temporal=1e-3, spatial=1.0, low_rank=0.0, robust_scale=1e-3, order=1)
"""Values of Dai, Deng, He (2017), section 5: λ1 = 1e-3, λ2 = 1, first order, no low-rank prior; unit: the tracks' RMS radius."""

STIFFEST = 30.0
"""Largest λ1 of `auto` with a robust loss: no path bends towards an outlier."""

SOFTEST = 1.0
"""Smallest λ1 of `auto` with a robust loss, for rough tracks with few frames."""

STIFFNESS = 0.1
"""λ1 times the roughness, RMS radii, small enough that deformation is not taken for an outlier."""

JUMP_RATIO, MIN_JUMP, MAX_JUMP_SHARE = 12.0, 0.05, 0.02
"""A third difference above `JUMP_RATIO` times the typical one and above `MIN_JUMP` RMS radii is a jump. If the share of
jumps exceeds `MAX_JUMP_SHARE`, the tracks contain gross outliers."""

SPATIAL_SHARE = 3e-4
"""λ2/λ1 of `auto`: enough smoothing over neighbours to resist outliers, too little to flatten the depth."""

LEAST_SQUARES_SHARE = 1e-2
"""λ2/λ1 of `auto` for tracks with gross outliers but no robust loss, where some flattening is acceptable."""

LOW_RANK_SHARE = 3e-4
"""λ3/λ1 of `auto` with the low-rank prior."""

MIN_NOISE_STD = 1e-4
"""Floor of the noise standard deviation used with the Gaussian prior, normalized units."""

BENDING_SHARE, BENDING_MODES = 0.3, 2.0
"""λ2/λ1 of `auto` with the Gaussian prior, times the mean square of AX. Below 1, because the covariance already includes
the bending; reduced in proportion if `BENDING_MODES` times the number of modes is below the number of frames. Error on
faces of 99 frames with known cameras: .0114 without the reduction, .0108 with it."""

ROBUST_SCALE_RANGE = (1e-3, 1e-2)
"""Range of the robust scale, which follows the noise, normalized units."""

MAX_ROBUST_SCALE = 0.1
"""Largest robust scale with the Gaussian prior, normalized units; larger because outliers are rejected before its fit."""


def choose_weights(
    normalized: Normalized,
    covariance: ShapeCovariance | None,
    laplacian: Laplacian | None,
    settings: Settings,
) -> tuple[Weights, float, dict[str, str]]:
    """Return the weights, the noise standard deviation they assume (normalized units), and the reasons by name."""
    if covariance is not None:
        noise = noise_std(covariance)
        chosen, reason = _from_covariance(covariance, settings)
    else:
        rough = roughness_of(normalized)
        noise = rough.noise_std
        chosen, reason = _from_data(rough, settings)
    if settings.preset == "paper":
        chosen, reason = PAPER, "The paper's values."
    given = replace(
        chosen,
        temporal=chosen.temporal if settings.temporal_weight is None else settings.temporal_weight,
        spatial=chosen.spatial if settings.spatial_weight is None else settings.spatial_weight,
        low_rank=chosen.low_rank if settings.low_rank_weight is None else settings.low_rank_weight,
        robust_scale=chosen.robust_scale if settings.robust_scale is None else settings.robust_scale,
        order=chosen.order if settings.temporal_order is None else settings.temporal_order,
    )
    if laplacian is None:
        given = replace(given, spatial=0.0)
    if settings.prior != "smooth+low_rank":
        given = replace(given, low_rank=0.0)
    return given, noise, {"weights": reason}


@dataclass(frozen=True, slots=True)
class Roughness:
    """Noise and jumps of the tracks, estimated from third differences over frames."""

    noise_std: float
    """Upper estimate of the noise's standard deviation, normalized units."""

    jumps: float
    """Share of third differences far above the typical one, a sign of gross outliers."""


def roughness_of(normalized: Normalized) -> Roughness:
    """Return noise and jumps of the tracks.

    The noise is the standard deviation of white noise with the same median absolute third difference over frames.
    Smooth motion contributes little to it, and a median is robust to outliers. Short sequences use differences of lower order. The
    weight of a difference is the least confidence of its observations.
    """
    order = min(3, len(normalized.points) - 1)
    differences = np.abs(np.diff(normalized.points, n=order, axis=0))
    weight = np.ones(differences.shape[:2])
    for start in range(order + 1):
        weight = np.minimum(weight, normalized.visible[start : start + len(differences)])
    whole = weight > 0
    if not whole.any():
        return Roughness(0.0, 0.0)
    seen, weight = differences[whole], weight[whole]
    typical = 1.4826 * weighted_median(seen.ravel(), np.repeat(weight, 2))
    jumps = seen.max(axis=1) > max(JUMP_RATIO * typical, MIN_JUMP)
    return Roughness(typical / magnified(order), float(weight[jumps].sum() / weight.sum()))


def noise_std(covariance: ShapeCovariance) -> float:
    """Return the noise standard deviation assumed with the Gaussian prior, normalized units."""
    return max(float(covariance.noise_variance**0.5), MIN_NOISE_STD)


def _from_covariance(covariance: ShapeCovariance, settings: Settings) -> tuple[Weights, str]:
    """Return the weights that make the energy proportional to a negative log posterior.

    Laplace residuals with standard deviation σ have the density exp(−√2 |r| / σ), so |r| + (σ / 2√2) xᵀQx is
    minimised; for Gaussian residuals it is r² + σ² xᵀQx.
    """
    sigma = noise_std(covariance)
    scale = float(np.clip(sigma, ROBUST_SCALE_RANGE[0], MAX_ROBUST_SCALE))
    strength = (sigma / 8**0.5 if settings.loss == "l1" else sigma**2) * relative_weight(settings, scale)
    chosen = replace(PAPER, temporal=strength, spatial=0.0, robust_scale=scale)
    scale = scale if settings.robust_scale is None else settings.robust_scale
    return chosen, (
        f"λ1 = {strength:.2g} weighs the Gaussian prior against noise of {sigma:.2g} RMS radii; the loss turns linear at "
        f"{scale:.2g} RMS radii."
    )


def relative_weight(settings: Settings, scale: float) -> float:
    """Return the weight of small residuals with the given robust scale relative to that with `scale`, at most 1.

    A scale ε of L1 above the noise makes the loss r²/2ε, and a scale δ of Huber below it 2δ|r|: with the same λ1, the prior would outweigh
    the observations.
    """
    if settings.robust_scale is None or settings.loss == "l2":
        return 1.0
    wider = settings.robust_scale / scale
    return min(1.0, wider if settings.loss == "huber" else 1 / wider)


def bending_weight(
    temporal: float,
    laplacian: Laplacian,
    shapes: NDArray[np.floating],
    modes: int,
    *,
    bends: NDArray[np.bool_] | None = None,
) -> float:
    """Return λ2 that preserves about the bending of shapes `(F, 3, P)` found without it.

    `modes` counts the mean shape as well. Only the points `bends`, shape `(P,)`, count; all do by default, or if there are none.
    """
    counted = np.ones(shapes.shape[2], dtype=bool) if bends is None or not bends.any() else bends
    flat = shapes.reshape(-1, shapes.shape[2])
    bent = np.asarray(laplacian.matrix @ flat.T, dtype=np.float64)[counted]
    rows = float((np.diff(laplacian.matrix.indptr) > 0)[counted].mean())
    share = BENDING_SHARE * min(1.0, BENDING_MODES * modes / len(shapes))
    return share * temporal * rows / max(float(np.mean(bent**2)), np.finfo(float).tiny)


def _from_data(rough: Roughness, settings: Settings) -> tuple[Weights, str]:
    spoiled = rough.jumps > MAX_JUMP_SHARE
    if settings.method != "robust" or settings.loss == "l2":
        return _least_squares(rough, spoiled=spoiled)
    scale = float(np.clip(rough.noise_std, *ROBUST_SCALE_RANGE))
    stiff = STIFFEST if spoiled else float(np.clip(STIFFNESS / max(rough.noise_std, 1e-9), SOFTEST, STIFFEST))
    stiff *= relative_weight(settings, scale)
    chosen = replace(
        PAPER, temporal=stiff, spatial=stiff * SPATIAL_SHARE, low_rank=stiff * LOW_RANK_SHARE, robust_scale=scale
    )
    scale = scale if settings.robust_scale is None else settings.robust_scale
    why = (
        "gross outliers must be resisted" if spoiled else f"frame-to-frame roughness is {rough.noise_std:.2g} RMS radii"
    )
    return chosen, (
        f"λ1 = {stiff:.3g} because {why} ({rough.jumps:.1%} of the third differences are jumps); λ2 = {SPATIAL_SHARE:g} λ1 keeps "
        f"depth from flattening; the loss turns linear at {scale:.2g} RMS radii."
    )


def _least_squares(rough: Roughness, *, spoiled: bool) -> tuple[Weights, str]:
    """Return the weights without a robust loss.

    At the published λ1 every frame is fitted almost exactly, so outliers enter the shape in full. Depth, which is inferred
    from other frames, inherits the outliers of those frames. Only strong smoothness in time and space protects against them.
    """
    stiff = STIFFEST if spoiled else PAPER.temporal
    share = LEAST_SQUARES_SHARE if spoiled else SPATIAL_SHARE
    chosen = replace(PAPER, temporal=stiff, spatial=stiff * share, low_rank=stiff * LOW_RANK_SHARE)
    why = (
        f"against gross outliers ({rough.jumps:.1%} of the third differences are jumps)" if spoiled else "as published"
    )
    return chosen, f"Least squares: λ1 = {stiff:g} {why}, λ2 = {share:g} λ1."

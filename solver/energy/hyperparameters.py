"""λ1, λ2, λ3 and the robust scale: the paper's values, or chosen from the data.

Near zero a robust loss is a parabola with curvature 1/ε, far steeper than a least-squares data term; away from zero its slope is
1, so that a point follows an outlier wherever bending its path costs less than the residual does. With the paper's λ1 = 1e-3
bending costs next to nothing and gross outliers win. A point is held back once λ1 ‖H S‖² of the jump outweighs the jump itself,
which for jumps of one RMS radius means λ1 well above 1; what fits exactly stays fitted exactly, because the loss has slope 1 from
the first residual on. λ2 must stay far below λ1: where the camera leaves depth open, the two alone decide it, and a strong λ2
flattens the surface. Measured in `benchmarks/README.md`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.energy.problem import Weights
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.operators.mesh_laplacian import Laplacian
from pliant.solver.settings import Settings
from pliant.solver.tracks.noise import magnified
from pliant.solver.tracks.normalization import Normalised

PAPER = Weights(temporal=1e-3, spatial=1.0, low_rank=0.0, robust_scale=1e-3, order=1, rank_floor=1e-4)
"""Dai, Deng, He (2017), section 5: λ1 = 1e-3, λ2 = 1, first order, no low-rank prior; in units of the tracks' RMS radius."""

STIFFEST = 30.0
"""Largest λ1 of `auto` with a robust loss: no path bends to an outlier."""

SOFTEST = 1.0
"""Smallest λ1 of `auto` with a robust loss: few frames, far apart."""

STIFFNESS = 0.1
"""λ1 times the roughness: a point that moves by its own deformation must not look like an outlier."""

FAR, FAR_AT_LEAST, JUMPS = 12.0, 0.05, 0.02
"""A third difference above `FAR` times the typical one (and this many RMS radii) is a jump; above this share of them, the tracks
have gross outliers."""

SPATIAL_SHARE = 3e-4
"""λ2/λ1 of `auto`: neighbours help against outliers without flattening the depth."""

LEAST_SQUARES_SHARE = 1e-2
"""λ2/λ1 of `auto` against outliers without a robust loss: worth some flattening."""

LOW_RANK_SHARE = 3e-4
"""λ3/λ1 of `auto` with the low-rank prior."""

FINEST = 1e-4
"""Smallest noise that the Gaussian prior is weighed against, normalised units."""

BENDING_SHARE, BENDING_MODES = 0.3, 2.0
"""λ2/λ1 of `auto` with the Gaussian prior, times the mean square of AX: below 1, for the covariance has seen the bending, too; and less
where so many times the modes are fewer than the frames, which then do not bend each in its own way. Measured against the first number
alone, known cameras: 99 frames of faces .0114 → .0108, with noise .0536 → .0522, horse, dancer and 10 frames of faces equal."""

SCALES = (1e-3, 1e-2)
"""Range of the robust scale that follows the noise."""

LARGEST_SCALE = 0.1
"""Largest robust scale with the Gaussian prior, from whose fit gross outliers have been left out."""


def choose_weights(
    normalised: Normalised,
    covariance: ShapeCovariance | None,
    laplacian: Laplacian | None,
    settings: Settings,
) -> tuple[Weights, float, dict[str, str]]:
    """Return the weights, the noise they are for (standard deviation, normalised units) and one sentence for each choice."""
    rough = roughness_of(normalised)
    noise = rough.noise if covariance is None else noise_std(covariance)
    if settings.preset == "paper":
        chosen, reason = PAPER, "The paper's values."
    elif covariance is not None:
        chosen, reason = _from_covariance(covariance, settings)
    else:
        chosen, reason = _from_data(rough, settings)
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


def without_effect(settings: Settings) -> tuple[str, ...]:
    """Return a sentence for each setting that was made and has no part in the solve."""
    said = []
    if settings.low_rank_weight is not None and settings.prior != "smooth+low_rank":
        said.append(f"low_rank_weight has no effect with prior {settings.prior}; set prior to smooth+low_rank.")
    if settings.temporal_order is not None and settings.gaussian:
        said.append("temporal_order has no effect with prior gaussian; set prior to smooth or smooth+low_rank.")
    if settings.precision == "float32" and settings.gaussian:
        said.append("precision has no effect with prior gaussian, which needs float64.")
    return tuple(said)


@dataclass(frozen=True, slots=True)
class Roughness:
    """What third differences over frames say about the tracks."""

    noise: float
    """Upper estimate of the noise's standard deviation, normalised units."""

    jumps: float
    """Share of the third differences that are far larger than the typical one: what gross outliers leave."""


def roughness_of(normalised: Normalised) -> Roughness:
    """Return noise and jumps of the tracks.

    The noise is the median absolute third difference of each coordinate over frames, as the standard deviation of white noise
    that would leave it; smooth motion leaves little of it, and outliers do not move a median. Short sequences use lower
    differences.
    """
    order = min(3, len(normalised.points) - 1)
    differences = np.abs(np.diff(normalised.points, n=order, axis=0))
    whole = np.ones(differences.shape[:2], dtype=bool)
    for start in range(order + 1):
        whole &= normalised.visible[start : start + len(differences)] > 0
    if not whole.any():
        return Roughness(0.0, 0.0)
    seen = differences[whole]
    typical = 1.4826 * float(np.median(seen))
    return Roughness(typical / magnified(order), float((seen.max(axis=1) > max(FAR * typical, FAR_AT_LEAST)).mean()))


def noise_std(covariance: ShapeCovariance) -> float:
    """Return the standard deviation of the noise that the Gaussian prior is weighed against, normalised units."""
    return max(float(covariance.noise**0.5), FINEST)


def _from_covariance(covariance: ShapeCovariance, settings: Settings) -> tuple[Weights, str]:
    """Return the weights with which the energy is the negative logarithm of a probability, times a constant.

    Residuals of Laplace's distribution with standard deviation σ have the density exp(−√2 |r| / σ), so that
    |r| + (σ / 2√2) xᵀQx is what to minimise; Gaussian ones make it r² + σ² xᵀQx.
    """
    sigma = noise_std(covariance)
    scale = float(np.clip(sigma, SCALES[0], LARGEST_SCALE))
    strength = sigma / 8**0.5 if settings.loss == "l1" else sigma**2
    chosen = replace(PAPER, temporal=strength, spatial=0.0, robust_scale=scale)
    return chosen, (
        f"λ1 = {strength:.2g} weighs the Gaussian prior against noise of {sigma:.2g} RMS radii; the loss turns linear at "
        f"{scale:.2g} RMS radii."
    )


def bending_weight(temporal: float, laplacian: Laplacian, shapes: NDArray[np.floating], modes: int) -> float:
    """Return λ2 for which the surface bends about as much as it does in shapes `(F, 3, P)`, of so many modes, found without it."""
    flat = shapes.reshape(-1, shapes.shape[2])
    bends = np.asarray(laplacian.matrix @ flat.T, dtype=np.float64)
    rows = float((np.diff(laplacian.matrix.indptr) > 0).mean())
    share = BENDING_SHARE * min(1.0, BENDING_MODES * modes / len(shapes))
    return share * temporal * rows / max(float(np.mean(bends**2)), np.finfo(float).tiny)


def _from_data(rough: Roughness, settings: Settings) -> tuple[Weights, str]:
    spoiled = rough.jumps > JUMPS
    if settings.method != "robust" or settings.loss == "l2":
        return _least_squares(rough, spoiled=spoiled)
    scale = float(np.clip(rough.noise, *SCALES))
    stiff = STIFFEST if spoiled else float(np.clip(STIFFNESS / max(rough.noise, 1e-9), SOFTEST, STIFFEST))
    chosen = replace(
        PAPER, temporal=stiff, spatial=stiff * SPATIAL_SHARE, low_rank=stiff * LOW_RANK_SHARE, robust_scale=scale
    )
    why = (
        "gross outliers have to be held back" if spoiled else f"frame-to-frame roughness is {rough.noise:.2g} RMS radii"
    )
    return chosen, (
        f"λ1 = {stiff:.3g} because {why} ({rough.jumps:.1%} of the third differences are jumps); λ2 = {SPATIAL_SHARE:g} λ1 keeps "
        f"depth from flattening; the loss turns linear at {scale:.2g} RMS radii."
    )


def _least_squares(rough: Roughness, *, spoiled: bool) -> tuple[Weights, str]:
    """Return the weights without a robust loss.

    At the published λ1 every frame is fitted all but exactly. An outlier is then in the shape in full, and the depth, which other
    frames alone show, is made of their outliers: worse than no depth. Stiff paths and stiff neighbours are all the help there is.
    """
    stiff = STIFFEST if spoiled else PAPER.temporal
    share = LEAST_SQUARES_SHARE if spoiled else SPATIAL_SHARE
    chosen = replace(PAPER, temporal=stiff, spatial=stiff * share, low_rank=stiff * LOW_RANK_SHARE)
    why = (
        f"against gross outliers ({rough.jumps:.1%} of the third differences are jumps)" if spoiled else "as published"
    )
    return chosen, f"Least squares: λ1 = {stiff:g} {why}, λ2 = {share:g} λ1."

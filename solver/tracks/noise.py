"""White-noise estimates from the tracks alone, without cameras or shapes."""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import NDArray
from pliant.solver.records import Floats

MIN_EIGENVALUE_RATIO = 1e-9
"""Minimum ratio of the median to the largest eigenvalue of the Gram matrix; below it the matrix counts as rank-deficient."""

OUTLIER_SHARE = 0.005
"""Share of gross outliers in the completion of the tracks above which outliers are rejected."""


RAYLEIGH_MEDIAN = 1.1774
"""Median length of a residual with two independent Gaussian coordinates, in their standard deviations: √(2 ln 2)."""


def magnified(order: int) -> float:
    """Return the factor by which differences of an order over frames amplify the standard deviation of white noise."""
    return float(np.sqrt(comb(2 * order, order)))


def roughness(gram: Floats) -> float:
    """Return the variance of white noise with the same median over frames of the mean squared third difference.

    This overestimates the noise, because jerky motion counts as noise. Short sequences use differences of lower order.
    """
    frames = len(gram) // 2
    order = min(3, frames - 1)
    differences = np.diff(np.eye(frames), n=order, axis=0)
    squared = [
        np.einsum("df,fg,dg->d", differences, gram[axis::2, axis::2], differences, optimize=True) for axis in (0, 1)
    ]
    return float(np.median(np.mean(squared, axis=0))) / magnified(order) ** 2


def typical_roughness(points: Floats) -> float:
    """Return the standard deviation of white noise with the same median third difference as complete tracks `(F, P, 2)`.

    Unlike `roughness`, it is robust to a few outliers.
    """
    order = min(3, len(points) - 1)
    size = np.abs(np.diff(points, n=order, axis=0))
    return 1.4826 * float(np.median(size)) / magnified(order)


def white_noise(gram: Floats) -> float:
    """Return σ², the median eigenvalue of W Wᵀ / P `(2F, 2F)`: low-rank motion leaves it at 0, noise raises it.

    With too few points the median is 0 regardless of the noise, so `roughness` is returned instead.
    """
    values = np.linalg.eigvalsh(gram)
    median = float(values[len(values) // 2])
    return median if median > MIN_EIGENVALUE_RATIO * float(values[-1]) else roughness(gram)


def weighted_median(values: NDArray[np.floating], weights: NDArray[np.floating]) -> float:
    """Return the smallest value with at least half of the weight at or below it; the usual median for equal weights."""
    if (weights == weights[0]).all():
        return float(np.median(values))
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weights[order])
    return float(values[order[int(np.searchsorted(below, 0.5 * below[-1]))]])

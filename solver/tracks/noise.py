"""How strong white noise is, from the tracks alone: before there are cameras or shapes."""

from __future__ import annotations

from math import comb

import numpy as np
from pliant.solver.records import Floats

RANK = 1e-9
"""Median eigenvalue over the largest from which there are more points than rows of W."""

SPOILED = 0.005
"""Share of gross outliers in the completion of the tracks from which they are rejected."""


def magnified(order: int) -> float:
    """Return by how much differences of that order over frames magnify the standard deviation of white noise."""
    return float(np.sqrt(comb(2 * order, order)))


def roughness(gram: Floats) -> float:
    """Return the median over frames of the tracks' mean squared third difference, as the variance of white noise that would leave it.

    An upper estimate: what moves unsteadily counts as noise. Short sequences use lower differences.
    """
    frames = len(gram) // 2
    order = min(3, frames - 1)
    differences = np.diff(np.eye(frames), n=order, axis=0)
    squared = [
        np.einsum("df,fg,dg->d", differences, gram[axis::2, axis::2], differences, optimize=True) for axis in (0, 1)
    ]
    return float(np.median(np.mean(squared, axis=0))) / magnified(order) ** 2


def typical_roughness(points: Floats) -> float:
    """Return the standard deviation of white noise that would leave the median third difference of complete tracks `(F, P, 2)`.

    Unlike `roughness` it does not mind a few wrong points.
    """
    order = min(3, len(points) - 1)
    size = np.abs(np.diff(points, n=order, axis=0))
    return 1.4826 * float(np.median(size)) / magnified(order)


def white_noise(gram: Floats) -> float:
    """Return σ² from the median eigenvalue of W Wᵀ / P `(2F, 2F)`, which no motion of low rank raises, but noise does.

    Too few points leave it 0 whatever the noise; then it is the roughness, if there is a sequence of frames to tell it from.
    """
    values = np.linalg.eigvalsh(gram)
    median = float(values[len(values) // 2])
    return median if median > RANK * float(values[-1]) else roughness(gram)

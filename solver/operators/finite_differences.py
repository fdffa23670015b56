"""Temporal smoothness: the difference operator H and the bands of HᵀH."""

from __future__ import annotations

import math

import numpy as np
from pliant.solver.records import Floats


def difference_bands(num_frames: int, order: int) -> Floats:
    """Return the upper bands of HᵀH, shape `(order + 1, F)`; `bands[k, f]` couples frames f and f + k (0 beyond the end).

    H takes differences over frames: x[f+1] − x[f] for order 1 (Dai, Deng, He 2017, eq. 3), x[f+2] − 2x[f+1] + x[f] for
    order 2. A sequence shorter than the stencil uses the highest order that fits.
    """
    order = min(order, num_frames - 1)
    stencil = np.array([(-1.0) ** (order - k) * math.comb(order, k) for k in range(order + 1)])
    bands = np.zeros((order + 1, num_frames))
    for start in range(num_frames - order):
        for k in range(order + 1):
            bands[k, start : start + order + 1 - k] += stencil[: order + 1 - k] * stencil[k:]
    return bands

"""The energy to minimise, as a record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.operators.mesh_laplacian import Laplacian
from pliant.solver.records import Floats

Array = NDArray[np.floating]


@dataclass(frozen=True, slots=True, eq=False)
class Weights:
    """Weights and scales of the energy, in normalized units."""

    temporal: float
    """λ1."""
    spatial: float
    """λ2; 0 without a mesh."""
    low_rank: float
    """λ3; 0 for the paper's prior."""
    robust_scale: float
    """ε of the smoothed L1 or δ of Huber."""
    order: int
    """Order of H."""
    rank_floor: float = 0.0
    """δ of the low-rank prior: variance of a mode, per point, below which it counts as noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The energy to minimise, normalized units."""

    points: Array
    """Centred tracks, shape `(F, 2, P)`."""
    confidence: Array
    """v, shape `(F, P)`."""
    projections: Array
    """s_f times the first two rows of R_f, shape `(F, 2, 3)`."""
    loss: str
    weights: Weights
    bands: Floats
    """λ1 times the bands of HᵀH, shape `(order + 1, F)`; 0 with a Gaussian prior, which replaces them."""
    laplacian: Laplacian | None
    axes: Floats
    """B (3×3): world shapes are B X. The identity unless the prior is Gaussian; its coordinates are independent along B."""
    quadratic: PathPrior | None = None
    """λ1 times the inverse covariance over frames of each coordinate: the Gaussian prior."""

    moving: bool = True
    """Whether translations are estimated with the shapes and every frame's shape is centred; not for a part of the points."""

"""Records of the energy to minimise and its weights."""

from __future__ import annotations

from dataclasses import dataclass

from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.operators.mesh_laplacian import Laplacian
from pliant.solver.records import Array, Floats


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


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The energy to minimise, normalized units."""

    points: Array
    """Centred tracks, shape `(F, 2, P)`."""
    confidence: Array
    """v, shape `(F, P)`, in [0, 1]; 0 where hidden or rejected."""
    projections: Array
    """s_f times the first two rows of R_f, shape `(F, 2, 3)`."""
    loss: str
    weights: Weights
    bands: Floats
    """λ1 times the upper bands of HᵀH, shape `(order + 1, F)`; 0 with a Gaussian prior, which replaces HᵀH."""
    laplacian: Laplacian | None
    axes: Floats
    """B (3×3): shapes in world axes are B X. The identity, unless a Gaussian prior is independent along other axes."""
    quadratic: PathPrior | None = None
    """The Gaussian prior: λ1 times the inverse covariance over frames of each coordinate."""

    moving: bool = True
    """Whether to estimate translations with the shapes and centre every frame's shape; False for a block of the points."""

"""Hierarchy of coarser surfaces for the multilevel preconditioner, by smoothed aggregation.

A preconditioner with one block per point ignores the coupling by the spatial term. Smooth deformations cost almost nothing
in that term, so conjugate gradients would need about as many iterations as the surface is wide in points. On coarser levels
the same deformations are rough. Each level aggregates points around centres, no two of which share a neighbour (chosen in
parallel by largest random number: Luby, 1986), and smooths the aggregates once over the graph (Vaněk, Mandel, Brezina
1996). The corrections of all levels are added (Bramble, Pasciak, Xu 1990), so each level needs only the inverses of its
blocks. The columns of every Π_l have unit length, so the temporal term is the same on all levels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats
from scipy import sparse

Matrix = sparse.csr_array[Any]

COARSEST = 8
"""Number of points at or below which no further level is built."""

SMOOTHING = 0.6
"""Weight of the neighbours' mean in the smoothing step."""


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Transfer from one level to the next coarser one."""

    down: Matrix
    """Restriction of residuals, shape `(P_l, P_l−1)`: the transpose of `up`."""

    up: Matrix
    """Prolongation of corrections."""

    mean: Matrix
    """Averaging of weights, with rows of sum 1, shape `(P_l, P_l−1)`."""

    bending: Floats
    """Diagonal of ΠᵀAᵀAΠ, shape `(P_l,)`."""

    def rounded(self, kind: np.dtype[np.floating]) -> Level:
        """Return the level in another precision."""
        return replace(self, down=self.down.astype(kind), up=self.up.astype(kind), mean=self.mean.astype(kind))


def build_levels(laplacian: Matrix, *, seed: int = 0) -> tuple[Level, ...]:
    """Return the coarser levels, finest first, for a Laplacian A, shape `(P, P)`; `seed` controls the choice of centres."""
    graph = _joined(abs(laplacian) + abs(laplacian.T))
    whole: Matrix = sparse.csr_array(sparse.eye_array(laplacian.shape[0], format="csr"))
    scale = np.ones(laplacian.shape[0])
    levels: list[Level] = []
    while graph.shape[0] > COARSEST:
        pulse()
        joined = _aggregates(graph, seed)
        pulse()
        if joined.shape[1] > 0.7 * joined.shape[0]:  # only isolated points remain
            break
        smooth = _smoothed(graph, joined)
        pulse()
        whole = sparse.csr_array(whole @ smooth)
        before, scale = scale, 1 / np.sqrt(np.asarray(whole.power(2).sum(axis=0)).ravel())
        up = sparse.csr_array(sparse.diags_array(1 / before) @ smooth @ sparse.diags_array(scale))
        squared = sparse.csr_array(up.power(2).T)
        share = 1 / np.asarray(squared.sum(axis=1)).ravel()
        bends = sparse.csr_array(laplacian @ whole).power(2).sum(axis=0)
        levels.append(
            Level(
                _short(up.T),
                _short(up),
                _short(sparse.diags_array(share) @ squared),
                np.asarray(bends, dtype=np.float64).ravel() * scale**2,
            )
        )
        graph = _joined(joined.T @ graph @ joined)
    return tuple(levels)


def _aggregates(graph: Matrix, seed: int) -> Matrix:
    """Return the assignment of points to centres as a 0/1 matrix, shape `(P, centres)`."""
    size = graph.shape[0]
    near = _joined(graph @ graph + graph)
    centre = _independent(near, seed)
    owner = np.full(size, -1)
    owner[centre] = np.arange(len(centre))
    for _ in range(2):  # neighbours of centres first, then the remaining points through a neighbour's centre
        owner = np.where(owner >= 0, owner, _largest(graph, owner))
    left = owner < 0
    owner[left] = len(centre) + np.arange(int(left.sum()))
    return sparse.csr_array((np.ones(size), (np.arange(size), owner)), shape=(size, int(owner.max()) + 1))


def _independent(graph: Matrix, seed: int) -> NDArray[np.intp]:
    """Return the indices of a maximal independent set of the graph."""
    size = graph.shape[0]
    rank = np.random.default_rng(seed).permutation(size)
    open_, chosen = np.ones(size, dtype=bool), np.zeros(size, dtype=bool)
    while open_.any():
        pulse()
        mine = np.where(open_, rank, -1)
        taken = open_ & (mine > _largest(graph, mine))
        chosen |= taken
        open_ &= ~taken & (_largest(graph, np.where(taken, 1, -1)) < 0)
    return np.flatnonzero(chosen)


def _largest(graph: Matrix, values: NDArray[Any]) -> NDArray[Any]:
    """Return the largest value among each point's neighbours, −1 if it has none."""
    padded = np.append(values[graph.indices], -1)  # otherwise a last row without neighbours would start beyond the end
    largest = np.maximum.reduceat(padded, graph.indptr[:-1])
    return np.where(np.diff(graph.indptr) > 0, largest, -1)


def _smoothed(graph: Matrix, joined: Matrix) -> Matrix:
    count = np.diff(graph.indptr)
    share = np.where(count > 0, SMOOTHING, 0.0)
    around = sparse.diags_array(share / np.maximum(count, 1)) @ graph
    return sparse.csr_array((sparse.diags_array(1 - share) + around) @ joined)


def _joined(matrix: Any) -> Matrix:
    """Return ones where the matrix couples two different points."""
    graph = sparse.coo_array(matrix)
    apart = (graph.row != graph.col) & (graph.data != 0)
    ones = np.ones(int(apart.sum()))
    return sparse.csr_array(sparse.coo_array((ones, (graph.row[apart], graph.col[apart])), shape=graph.shape))


def _short(matrix: Any) -> Matrix:
    result = sparse.csr_array(matrix)
    result.indices, result.indptr = result.indices.astype(np.int32), result.indptr.astype(np.int32)
    return result

"""Depths of an inextensible surface seen by pinhole cameras: the maximum-depth heuristic as one convex problem.

Chhatkuli, Pizarro, Collins and Bartoli, "Inextensible non-rigid structure-from-motion by second-order cone programming"
(TPAMI 2018): with viewing rays r_fi and depths z_fi, maximise Σ g_f z_fi subject to

    ‖z_fi r_fi − z_fj r_fj‖ ≤ d_ij   for neighbours i, j seen together in frame f,    Σ d_ij = 1,    z ≥ 0.

A surface that bends without stretching keeps its geodesic distances d_ij, which bound the Euclidean distances. The problem needs neither a
starting point nor a template. Hidden observations have no variables and no cones. The order of the frames has no effect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats
from scipy import sparse

Indices = NDArray[np.intp]

SOLVED = ("Solved", "AlmostSolved")
"""Accepted exit statuses of Clarabel."""

ACCURACY = 1e-5
"""Tolerances of gap and feasibility of the conic program; the subsequent refinement changes depths by 1e-2."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceGraph:
    """Viewing rays of points, and the edges between them whose lengths are constant."""

    rays: Floats
    """Viewing rays, shape `(F, A, 3)`, third coordinate 1."""

    confidence: Floats
    """Inverse variances of the points' image positions, relative to those of full confidence, shape `(F, A)`; 0 where hidden."""

    edges: Indices
    """Pairs of neighbours, shape `(E, 2)`."""

    arc_ratios: Floats | None = None
    """Arc–chord ratios: lengths of the edges along the surface relative to the distances of their ends, shape `(F, E)`; None if unknown,
    taken as 1."""

    def of(self, frames: Indices) -> SurfaceGraph:
        """Return the graph of these frames."""
        arc_ratios = None if self.arc_ratios is None else self.arc_ratios[frames]
        return replace(self, rays=self.rays[frames], confidence=self.confidence[frames], arc_ratios=arc_ratios)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Mask of the visible points, shape `(F, A)`."""
        return self.confidence > 0

    @property
    def pairs(self) -> tuple[Indices, Indices]:
        """Frame and edge index of every edge with both ends visible in a frame, sorted by frame."""
        frame, edge = np.nonzero(self.seen[:, self.edges[:, 0]] & self.seen[:, self.edges[:, 1]])
        return frame, edge

    @property
    def ends(self) -> tuple[Indices, Indices]:
        """Indices of the two observations of every pair among the visible ones, numbered frame by frame."""
        number = np.cumsum(self.seen.ravel()).reshape(self.seen.shape) - 1
        frame, edge = self.pairs
        return number[frame, self.edges[edge, 0]], number[frame, self.edges[edge, 1]]

    @property
    def weights(self) -> Floats:
        """Weight of the length of every pair: the harmonic mean of the confidences of its ends, whose variances add."""
        frame, edge = self.pairs
        first, second = (self.confidence[frame, self.edges[edge, end]] for end in (0, 1))
        return np.asarray(2 * first * second / (first + second))


def maximum_depth(graph: SurfaceGraph, *, should_stop: ShouldStop = never) -> Floats | None:
    """Return depths `(F, A)` of the deepest inextensible surface, in units of Σ d_ij; 0 where hidden.

    Return None if no two neighbours are visible together, if Clarabel finds no solution, or if `should_stop` returns True between its
    iterations.
    """
    if len(graph.pairs[0]) == 0:
        return None
    found = _solved(*_program(graph), gain=_gain(graph), cones=len(graph.pairs[0]), should_stop=should_stop)
    if found is None:
        return None
    depths = np.zeros(graph.seen.shape)
    depths[graph.seen] = np.maximum(found, 0.0)
    return depths if bool((found > 0).any()) else None


def _gain(graph: SurfaceGraph) -> Floats:
    """Return the weight g of every visible depth, shape `(O,)`: the frame's number of pairs per observation, relative to the maximum.

    With equal weights, the lengths of a frame with few pairs could take all of Σ d: its depths would grow, and all others collapse.
    """
    counts = graph.seen.sum(axis=1)
    ratio = np.bincount(graph.pairs[0], minlength=len(counts)) / np.maximum(counts, 1)
    return np.repeat(ratio / ratio.max(), counts)


def _program(graph: SurfaceGraph) -> tuple[sparse.csc_matrix, Floats]:
    """Return A and b of s = b − A x ∈ K, x = (depths, d). The rows are Σ d = 1, then z ≥ 0, then a cone of size 4 per pair."""
    _, edge = graph.pairs
    rays, (first, second) = graph.rays[graph.seen], graph.ends
    count, edges, pairs = len(rays), len(graph.edges), len(edge)
    cone = 1 + count + 4 * np.arange(pairs)
    blocks = [
        (np.zeros(edges, dtype=np.intp), count + np.arange(edges), np.ones(edges)),
        (1 + np.arange(count), np.arange(count), -np.ones(count)),
        (cone, count + edge, -np.ones(pairs)),
    ]
    for axis in range(3):
        blocks.append((cone + 1 + axis, first, -rays[first, axis]))
        blocks.append((cone + 1 + axis, second, rays[second, axis]))
    row, column, value = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    bound = np.zeros(1 + count + 4 * pairs)
    bound[0] = 1.0
    return sparse.csc_matrix((value, (row, column)), shape=(len(bound), count + edges)), bound


def _solved(
    matrix: sparse.csc_matrix, bound: Floats, *, gain: Floats, cones: int, should_stop: ShouldStop
) -> Floats | None:
    """Return the depths of the visible observations."""
    import clarabel  # imported here because only sequences that look like a sheet need it

    variables, observations = matrix.shape[1], len(gain)
    cost = np.zeros(variables)
    cost[:observations] = -gain
    kinds = [clarabel.ZeroConeT(1), clarabel.NonnegativeConeT(observations), *[clarabel.SecondOrderConeT(4)] * cones]
    options = clarabel.DefaultSettings()
    options.verbose = False
    options.max_threads = 1
    options.tol_gap_rel = options.tol_gap_abs = options.tol_feas = ACCURACY
    nothing = sparse.csc_matrix((variables, variables))
    solver = clarabel.DefaultSolver(nothing, cost, matrix, bound, kinds, options)
    solver.set_termination_callback(lambda _: should_stop())
    solved = solver.solve()
    return np.asarray(solved.x)[:observations] if str(solved.status) in SOLVED else None

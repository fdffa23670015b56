"""Spatial smoothness: the sparse Laplacian A of eq. 7 on a pixel grid or a triangle or quad mesh.

Every kind approximates 3 h² ∇², with h the distance between neighbours, as does the paper's sum of four second differences
on a grid, so λ2 has the same meaning on all meshes. To avoid contracting the boundary of an open surface, a grid uses only
complete second differences, and a mesh omits the rows of boundary vertices. A boundary vertex that appears in no other row
keeps its first-difference row, so that it stays connected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.solver.mesh import Mesh
from pliant.solver.operators.aggregation import Level, Matrix, build_levels
from pliant.solver.records import Floats, Ints
from scipy import sparse

STRENGTH = 12.0
"""Factor that scales the mean of the neighbours minus the vertex, h²∇²/4 for neighbours in all directions, to 3 h²∇²."""

SMALLEST = float(np.finfo(np.float64).tiny)
"""Floor of an area in a division: a face whose corners coincide has cotangent 0."""

DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""The paper's four second-difference filters: along a row, along a column, along both diagonals."""


@dataclass(frozen=True, slots=True, eq=False)
class Laplacian:
    """The spatial smoothness operator of one frame and coordinate."""

    matrix: Matrix
    """A, sparse, shape `(P, P)`; rows of boundary vertices are empty."""

    name: str
    """`grid8`, `uniform` or `cotangent`."""

    adjoint: Matrix
    """Aᵀ in compressed sparse row format."""

    grid: Ints | None = None
    """Point index of each grid cell, −1 for holes; None without a grid. Used by the cosine preconditioner."""

    levels: tuple[Level, ...] = ()
    """Coarser levels, finest first, for the preconditioner."""

    def rounded(self, kind: np.dtype[np.floating]) -> Laplacian:
        """Return the Laplacian in another precision."""
        if self.matrix.dtype == kind:
            return self
        return replace(
            self,
            matrix=self.matrix.astype(kind),
            adjoint=self.adjoint.astype(kind),
            levels=tuple(level.rounded(kind) for level in self.levels),
        )


def build_laplacian(
    mesh: Mesh | None, kind: str, reference: Floats | None = None, *, seed: int = 0
) -> Laplacian | None:
    """Return the Laplacian of the given kind, or None if no point has a neighbour.

    Parameters
    ----------
    mesh : Mesh or None
    kind : {"auto", "grid8", "uniform", "cotangent"}
        `auto` is `grid8` on a grid, else `uniform`.
    reference : array, shape (P, 3), optional
        A typical shape, in any unit, for the weights of `cotangent`; without it `cotangent` becomes `uniform`.
    seed : int
        Seed of the coarser levels of the preconditioner.
    """
    on_grid = mesh is not None and mesh.grid is not None and kind in ("auto", "grid8")
    if mesh is None or (len(mesh.faces) == 0 and not on_grid):
        return None
    if mesh.grid is not None and on_grid:
        matrix, name = _grid_matrix(mesh.grid, mesh.num_points), "grid8"
    elif kind == "cotangent" and reference is not None:
        matrix, name = _mesh_matrix(mesh, _cotangent_weights(mesh, reference)), "cotangent"
    else:
        matrix, name = _mesh_matrix(mesh, np.ones(len(mesh.edges))), "uniform"
    if matrix.nnz == 0:
        return None
    return Laplacian(matrix, name, sparse.csr_array(matrix.T), mesh.grid, build_levels(matrix, seed=seed))


def _grid_matrix(grid: Ints, num_points: int) -> Matrix:
    """Return the sum of the complete second differences at each cell; first differences for points in none of them."""
    rows, columns, values = [], [], []
    edges = []
    for down, right in DIRECTIONS:
        before, middle, after = (_shifted(grid, step * down, step * right) for step in (-1, 0, 1))
        whole = (before >= 0) & (middle >= 0) & (after >= 0)
        for neighbour, value in ((before, 1.0), (middle, -2.0), (after, 1.0)):
            rows.append(middle[whole])
            columns.append(neighbour[whole])
            values.append(np.full(int(whole.sum()), value))
        pair = (middle >= 0) & (after >= 0)
        edges.append(np.stack([middle[pair], after[pair]], axis=1))
    matrix = _assemble(np.concatenate(rows), np.concatenate(columns), np.concatenate(values), num_points)
    pairs = np.concatenate(edges)
    return _with_all_connected(matrix, pairs, np.ones(len(pairs)))


def _shifted(grid: Ints, down: int, right: int) -> Ints:
    """Return, for each cell, the point index `down` rows below and `right` columns to the right; −1 outside."""
    padded = np.pad(grid, 1, constant_values=-1)
    height, width = grid.shape
    return padded[1 + down : 1 + down + height, 1 + right : 1 + right + width]


def _mesh_matrix(mesh: Mesh, weights: Floats) -> Matrix:
    """Return `STRENGTH` times the weighted mean of the neighbours minus the vertex, for interior vertices."""
    edges = mesh.edges
    plain = _first_difference_rows(edges, weights, mesh.num_points)
    keep = np.ones(mesh.num_points)
    keep[_boundary(mesh)] = 0.0
    matrix = sparse.csr_array(sparse.diags_array(keep) @ plain)
    matrix.eliminate_zeros()
    return _with_all_connected(matrix, edges, weights)


def _first_difference_rows(edges: Ints, weights: Floats, num_points: int) -> Matrix:
    one, two = edges[:, 0], edges[:, 1]
    total = np.bincount(one, weights, num_points) + np.bincount(two, weights, num_points)
    share = np.divide(STRENGTH, total, out=np.zeros(num_points), where=total > 0)
    points = np.arange(num_points)
    rows = np.concatenate([one, two, points])
    columns = np.concatenate([two, one, points])
    values = np.concatenate([weights * share[one], weights * share[two], -STRENGTH * (total > 0)])
    return _assemble(rows, columns, values, num_points)


def _with_all_connected(matrix: Matrix, edges: Ints, weights: Floats) -> Matrix:
    """Return the matrix with first-difference rows for connected points that appear in no other row."""
    num_points = matrix.shape[1]
    touched = np.bincount(matrix.indices, minlength=num_points) > 0
    if touched.all() or len(edges) == 0:
        return matrix
    pick = sparse.diags_array(np.where(touched, 0.0, 1.0))
    result = sparse.csr_array(matrix + pick @ _first_difference_rows(edges, weights, num_points))
    result.eliminate_zeros()
    return result


def _boundary(mesh: Mesh) -> NDArray[np.intp]:
    """Return the vertices of edges that belong to one face only."""
    following = np.roll(mesh.faces, -1, axis=1)
    low, high = np.minimum(mesh.faces, following), np.maximum(mesh.faces, following)
    keys, count = np.unique(low.astype(np.int64) * mesh.num_points + high, return_counts=True)
    single = keys[count == 1]
    return np.unique(np.concatenate([single // mesh.num_points, single % mesh.num_points])).astype(np.intp)


def _cotangent_weights(mesh: Mesh, reference: Floats) -> Floats:
    """Return (cot α + cot β)/2 for each edge on the reference shape, clipped to 1 % to 100 times the typical weight.

    Quads are split along both diagonals with half weight each; the diagonals themselves get no weight.
    """
    faces = mesh.faces
    triangles = faces if faces.shape[1] == 3 else np.concatenate([np.roll(faces, -turn, 1)[:, :3] for turn in range(4)])
    keys = mesh.edges[:, 0].astype(np.int64) * mesh.num_points + mesh.edges[:, 1]
    total = np.zeros(len(keys))
    for corner in range(3):
        at, one, two = (triangles[:, (corner + step) % 3] for step in range(3))
        u, v = reference[one] - reference[at], reference[two] - reference[at]
        cross = np.linalg.norm(np.cross(u, v), axis=1)
        longest = np.maximum((u * u).sum(1), (v * v).sum(1))
        cotangent = np.einsum("ij,ij->i", u, v) / np.maximum(cross, np.maximum(1e-12 * longest, SMALLEST))
        edge = np.minimum(one, two).astype(np.int64) * mesh.num_points + np.maximum(one, two)
        place = np.searchsorted(keys, edge)
        place[place == len(keys)] = 0
        known = keys[place] == edge
        np.add.at(total, place[known], cotangent[known] / 2)
    # Obtuse or degenerate triangles have negative or vanishing weights, which would amplify roughness.
    typical = float(np.median(np.abs(total))) or 1.0
    return np.clip(total, 0.01 * typical, 100 * typical)


def _assemble(rows: NDArray[Any], columns: NDArray[Any], values: Floats, num_points: int) -> Matrix:
    places = rows.astype(np.int32), columns.astype(np.int32)  # 32-bit indices halve the memory traffic of each product
    matrix = sparse.csr_array(sparse.coo_array((values, places), shape=(num_points, num_points)))
    matrix.sum_duplicates()
    return matrix

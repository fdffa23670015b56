"""Choose fewer points and their mesh: every n-th row and column of a grid, or clusters of a mesh's vertices.

Without a mesh, every n-th point is kept, or as many as allowed, spread evenly over the picture.

A mesh is thinned by a centroidal Voronoi diagram on its edges (the idea of Valette and Chassery, Approximated centroidal Voronoi diagrams
for uniform polygonal mesh coarsening, 2004): seeds are spread over the picture, every vertex is assigned to the seed nearest along the
edges, and each seed moves to the vertex farthest from other clusters, preferring those seen often. Two clusters are neighbours if an edge
of the mesh joins them, so the new faces are the triangles of the mesh whose corners lie in three clusters. The kept points are the seeds,
without those in no face unless fewer than `MIN_POINTS` would remain: tracks of the input, unchanged and in the input's order, never
averages. An edge is as long as its maximum length in the picture over `MEASURED_FRAMES` frames, the best 2-D estimate of its length on the
surface.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.options import Options
from pliant.solver import InvalidInput, Mesh
from pliant.solver.mesh import triangles_of
from pliant.solver.records import MIN_POINTS
from pliant.worker.formats.tracks.selection import selected

if TYPE_CHECKING:
    from scipy.sparse import csr_array  # imported only where a mesh is thinned, which few inputs need

SEED_MOVES = 4
"""Number of moves of the seeds; further moves hardly change the spread."""

MEASURED_FRAMES = 8
"""Number of frames in which lengths and positions are measured."""

Indices = NDArray[np.intp]


def thin(
    points: NDArray[np.generic], visible: NDArray[np.float64] | None, mesh: Mesh | None, options: Options
) -> tuple[Indices, Mesh | None, list[str]]:
    """Choose points by the options `stride` and `max_points`.

    Points are `(F, P, 2)` of the selected frames; hidden ones are NaN or have 0 in `visible (F, P)`. Returns the increasing indices of the
    kept points, their mesh, None if it is still to be generated, and notes.

    Raises
    ------
    InvalidInput
        Code too_few_points, if fewer than four are left.
    """
    count = points.shape[1]
    limit = count if options.max_points is None else options.max_points
    if options.stride == 1 and limit >= count:
        return np.arange(count), mesh, []
    kept, coarse, notes = _thinned(points, visible, mesh, options.stride, limit)
    if len(kept) < MIN_POINTS <= count:
        by_stride = options.max_points is None
        raise InvalidInput(
            "too_few_points", field="options.stride" if by_stride else "options.max_points",
            expected=f"a value that leaves {MIN_POINTS} points or more", got=f"{len(kept)} of {count}",
            hint="Use a smaller stride." if by_stride else "Use a larger max_points, or a smaller stride.",
        )  # fmt: skip
    return kept, coarse, notes


def _thinned(
    points: NDArray[np.generic], visible: NDArray[np.float64] | None, mesh: Mesh | None, stride: int, limit: int
) -> tuple[Indices, Mesh | None, list[str]]:
    count = points.shape[1]
    if mesh is not None and mesh.grid is not None:
        return _thin_grid(mesh.grid, stride, limit)
    if mesh is None or len(mesh.faces) == 0:
        kept = np.arange(0, count, stride)
        how = f"one in {stride}" if stride > 1 else "all"
        if len(kept) > limit:
            places, seen = _places(*selected(points, visible, np.s_[:, kept]))
            kept, how = kept[spread(places, seen, limit)], "spread evenly"
        empty = None if mesh is None else Mesh.from_faces(np.zeros((0, 3), np.int32), len(kept))
        return kept, empty, [f"{len(kept)} of {count} points are used: {how}."]
    return _thin_mesh(points, visible, mesh, min(limit, math.ceil(count / stride)))


def _thin_grid(grid: NDArray[np.int32], stride: int, limit: int) -> tuple[Indices, Mesh, list[str]]:
    while stride < max(grid.shape) and int((grid[::stride, ::stride] >= 0).sum()) > limit:
        stride += 1
    coarse = _without_loose_cells(grid[::stride, ::stride])
    kept = np.sort(coarse[coarse >= 0])
    numbers = np.full(int(grid.max()) + 1, -1)
    numbers[kept] = np.arange(len(kept))
    renumbered = np.where(coarse >= 0, numbers[np.maximum(coarse, 0)], -1)
    note = f"{len(kept)} of {len(numbers)} points are used: one in {stride} rows and columns of the grid."
    return kept.astype(np.intp), Mesh.from_grid(renumbered), [note]


def _without_loose_cells(grid: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return a grid with holes (−1) for the points that no quad of it contains; unchanged if it has no quads."""
    corners = (np.s_[:-1, :-1], np.s_[1:, :-1], np.s_[1:, 1:], np.s_[:-1, 1:])
    whole = np.all([grid[corner] >= 0 for corner in corners], axis=0)
    inside = np.zeros(grid.shape, dtype=bool)
    for corner in corners:
        inside[corner] |= whole
    return np.where(inside, grid, -1) if whole.any() else grid


def _thin_mesh(
    points: NDArray[np.generic], visible: NDArray[np.float64] | None, mesh: Mesh, limit: int
) -> tuple[Indices, Mesh, list[str]]:
    from scipy.sparse.csgraph import connected_components

    places, seen = _places(points, visible)
    triangles = triangles_of(mesh.faces)
    graph = edge_lengths(places, seen, mesh.edges)
    used = np.unique(mesh.faces).astype(np.intp)
    parts = np.unique(connected_components(graph, directed=False)[1][used], return_inverse=True)[1]
    seeds = used[spread(places[:, used], seen[:, used], limit, parts)]
    cluster = _nearest(graph, seeds)
    for _ in range(SEED_MOVES):
        seeds = _middles(graph, mesh.edges, cluster, seeds, seen.mean(axis=0))
        cluster = _nearest(graph, seeds)
    order = np.argsort(seeds)
    kept = seeds[order]
    numbers = np.full(places.shape[1] + 1, -1)
    numbers[kept] = np.arange(len(kept))
    faces = numbers[np.where(cluster >= 0, seeds[np.maximum(cluster, 0)], -1)][triangles]
    apart = (
        (faces[:, 0] != faces[:, 1])
        & (faces[:, 1] != faces[:, 2])
        & (faces[:, 2] != faces[:, 0])
        & (faces >= 0).all(axis=1)
    )
    _, first = np.unique(np.sort(faces[apart], axis=1), axis=0, return_index=True)
    faces = faces[apart][np.sort(first)]
    inside, renumbered = np.unique(faces, return_inverse=True)
    if len(inside) >= MIN_POINTS:
        kept, faces = kept[inside], renumbered.reshape(-1, 3)
    coarse = Mesh.from_faces(faces.astype(np.int32), len(kept))
    alone = len(kept) - len(inside)
    notes = [
        f"{len(kept)} of {places.shape[1]} points are used, spread evenly over the mesh; "
        f"{len(mesh.faces)} faces became {len(coarse.faces)}."
    ]
    if alone:
        belong = "1 of the points used belongs" if alone == 1 else f"{alone} of the points used belong"
        notes.append(f"{belong} to no face; smoothness in space has no effect there.")
    return kept, coarse, notes


def spread(places: NDArray[np.float64], seen: NDArray[np.bool], limit: int, parts: Indices | None = None) -> Indices:
    """Choose at most `limit` points evenly over the picture: one point per cell and part, with the smallest cells that the limit allows.

    `places (m, P, 2)` are positions in some frames, `seen (m, P)` whether they are valid. `parts (P,)` numbers the connected
    components, which are sampled separately.
    """
    with np.errstate(invalid="ignore"):
        weight = seen[..., None].astype(np.float64)
        mean = (places * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1)
    if parts is not None and parts.max() + 1 > limit:
        largest = np.argsort(np.bincount(parts), kind="stable")[::-1][:limit]
        return np.array([np.flatnonzero(parts == part)[0] for part in np.sort(largest)])
    low, extent = mean.min(axis=0), float(np.ptp(mean, axis=0).max()) or 1.0
    finest, coarsest = extent / (4 * math.sqrt(len(mean)) + 4), 2 * extent
    chosen = _one_a_cell(mean, low, finest, parts)
    for _ in range(24) if len(chosen) > limit else ():
        size = math.sqrt(finest * coarsest)
        found = _one_a_cell(mean, low, size, parts)
        if len(found) > limit:
            finest = size
        else:
            coarsest, chosen = size, found
    return chosen if len(chosen) <= limit else _one_a_cell(mean, low, coarsest, parts)[:limit]


def _one_a_cell(mean: NDArray[np.float64], low: NDArray[np.float64], size: float, parts: Indices | None) -> Indices:
    """Return the point nearest the centre of each cell (and part) that holds points."""
    cell = np.floor((mean - low) / size)
    away = np.linalg.norm((mean - low) / size - cell - 0.5, axis=1)
    keys = np.column_stack([cell.astype(np.int64), np.zeros(len(cell), np.int64) if parts is None else parts])
    order = np.argsort(away, kind="stable")
    _, first = np.unique(keys[order], axis=0, return_index=True)
    return np.sort(order[first])


def edge_lengths(places: NDArray[np.float64], seen: NDArray[np.bool], edges: NDArray[np.int32]) -> csr_array:
    """Return the mesh's edges as a graph; an edge's length is the maximum distance of its ends over the frames that show both."""
    from scipy.sparse import csr_array

    one, two = edges[:, 0], edges[:, 1]
    lengths = np.zeros(len(edges))
    for frame, there in zip(places, seen, strict=True):
        apart = np.where(there[one] & there[two], np.linalg.norm(frame[one] - frame[two], axis=1), 0.0)
        lengths = np.maximum(lengths, apart)
    known = lengths > 0
    lengths[~known] = float(np.median(lengths[known])) if known.any() else 1.0
    return csr_array((lengths, (one, two)), shape=(places.shape[1], places.shape[1]))


def _nearest(graph: csr_array, seeds: Indices) -> Indices:
    """Return the number of the seed nearest along the edges, −1 if none can be reached."""
    from scipy.sparse.csgraph import dijkstra

    _, _, source = dijkstra(graph, directed=False, indices=seeds, min_only=True, return_predecessors=True)
    number = np.full(graph.shape[0] + 1, -1, dtype=np.intp)
    number[seeds] = np.arange(len(seeds))
    return number[np.where(source < 0, graph.shape[0], source)]


def _middles(
    graph: csr_array, edges: NDArray[np.int32], cluster: Indices, seeds: Indices, shown: NDArray[np.float64]
) -> Indices:
    """Return each cluster's vertex farthest from other clusters, preferring those seen often; the seeds if there are no other clusters."""
    from scipy.sparse.csgraph import dijkstra

    border = np.unique(edges[cluster[edges[:, 0]] != cluster[edges[:, 1]]])
    if len(border) == 0:
        return seeds
    depth = dijkstra(graph, directed=False, indices=border, min_only=True)
    depth = np.where(np.isfinite(depth) & (cluster >= 0), depth * (0.1 + shown), -1.0)
    depth[seeds] += 1e-12  # in a tie, the seed stays
    order = np.lexsort((depth, cluster))
    last = np.flatnonzero(np.append(np.diff(cluster[order]) != 0, True))  # the deepest of each cluster comes last
    moved = seeds.copy()
    moved[cluster[order[last]][cluster[order[last]] >= 0]] = order[last][cluster[order[last]] >= 0]
    return moved


def _places(
    points: NDArray[np.generic], visible: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.bool]]:
    """Return positions in evenly chosen frames, 0 where hidden, and where they are visible."""
    chosen = np.unique(np.linspace(0, len(points) - 1, MEASURED_FRAMES).round().astype(int))
    places = np.array(points[chosen], dtype=np.float64)
    seen: NDArray[np.bool] = np.asarray(np.isfinite(places).all(axis=2))
    if visible is not None:
        seen &= visible[chosen] > 0
    places[~seen] = 0.0
    return places, seen

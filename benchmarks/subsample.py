"""Thin a dense sequence to evenly spread points, with a mesh that follows the surface."""

from __future__ import annotations

import numpy as np
from pliant.solver import Mesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra


def thin_points(points: np.ndarray, count: int) -> np.ndarray:
    """Choose `count` points, each the farthest from those before it (Gonzalez 1985); indices in ascending order."""
    chosen = np.zeros(count, dtype=np.int64)
    distance = np.full(len(points), np.inf)
    for index in range(1, count):
        distance = np.minimum(distance, np.square(points - points[chosen[index - 1]]).sum(axis=1))
        chosen[index] = distance.argmax()
    return np.sort(chosen)


def thin_mesh(mesh: Mesh, points: np.ndarray, kept: np.ndarray) -> Mesh:
    """Triangulate the kept points along the surface.

    The triangulation is the dual of their geodesic Voronoi diagram: every vertex belongs to the kept vertex nearest along the edges, and a
    triangle whose corners belong to three different kept vertices becomes a triangle between them.
    """
    edges = mesh.edges
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    graph = coo_array((np.maximum(lengths, 1e-12), (edges[:, 0], edges[:, 1])), shape=(len(points),) * 2).tocsr()
    _, _, owner = dijkstra(graph, directed=False, indices=kept, min_only=True, return_predecessors=True)
    number = np.full(len(points), -1)
    number[kept] = np.arange(len(kept))
    reached = owner >= 0
    owned = np.full(len(points), -1)
    owned[reached] = number[owner[reached]]
    triangles = (
        mesh.faces if mesh.faces.shape[1] == 3 else np.concatenate([mesh.faces[:, :3], mesh.faces[:, [0, 2, 3]]])
    )
    corners = owned[triangles]
    ordered = np.sort(corners, axis=1)
    distinct = (ordered[:, 0] >= 0) & (ordered[:, 0] < ordered[:, 1]) & (ordered[:, 1] < ordered[:, 2])
    _, first = np.unique(ordered[distinct], axis=0, return_index=True)
    return Mesh.from_faces(corners[distinct][np.sort(first)], len(kept))

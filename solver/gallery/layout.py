"""Layout of the points of an open surface in its parameter plane, with their mesh.

Parameters are (u, v) in [−1, 1]², u right, v down. "grid" gives a pixel grid that may have holes, "triangles" an
irregular triangulation; both have exactly the requested number of points.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pliant.solver.gallery.sequence import refusal
from pliant.solver.mesh import Mesh
from pliant.solver.records import MIN_POINTS, Floats, Ints

Kind = Literal["grid", "triangles"]


def disc(num_points: int, mesh: Kind) -> tuple[Floats, Mesh]:
    """Return points in the unit disc, `(P, 2)`, and their mesh.

    The grid consists of the P cells of smallest radius in a square; the triangles are the Delaunay triangulation of a
    sunflower spiral (Vogel 1979), which distributes any number of points evenly.
    """
    _check(num_points, mesh)
    if mesh == "triangles":
        index = np.arange(num_points) + 0.5
        angle = np.pi * (1 + np.sqrt(5)) * index
        flat = np.sqrt(index / num_points)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return flat, Mesh.from_faces(_triangulate(flat), num_points)
    side = int(np.ceil(np.sqrt(4 * num_points / np.pi))) + 1
    axis = np.linspace(-1, 1, side)
    plane = np.stack(np.meshgrid(axis, axis), axis=-1)
    inside = np.argsort(np.hypot(plane[..., 0], plane[..., 1]).ravel(), kind="stable")[:num_points]
    return _numbered(plane, inside)


def rectangle(num_points: int, mesh: Kind, *, aspect: float) -> tuple[Floats, Mesh]:
    """Return points in [−1, 1]², `(P, 2)`, and their mesh, for a sheet `aspect` times as wide as high.

    The last column of the grid may be incomplete, so any P is possible.
    """
    _check(num_points, mesh)
    rows = max(2, round(np.sqrt(num_points / aspect)))
    columns = int(np.ceil(num_points / rows))
    plane = np.stack(np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows)), axis=-1)
    inside = np.arange(rows * columns).reshape(rows, columns).T.ravel()[:num_points]
    flat, grid = _numbered(plane, inside)
    if mesh == "grid":
        return flat, grid
    # Jitter in the interior makes the valences uneven; the border stays straight.
    spread = np.array([2 / max(columns - 1, 1), 2 / max(rows - 1, 1)])
    jitter = np.random.default_rng(0).uniform(-0.35, 0.35, flat.shape) * spread
    flat = np.where(np.abs(flat) < 1 - 1e-9, flat + jitter, flat)
    return flat, Mesh.from_faces(_triangulate(flat * (aspect, 1.0)), num_points)


def _numbered(plane: Floats, inside: NDArray[np.int64]) -> tuple[Floats, Mesh]:
    """Assign point indices to the chosen cells row by row, and drop empty rows and columns."""
    grid = np.full(plane.shape[:2], -1, dtype=np.int32)
    grid.ravel()[np.sort(inside)] = np.arange(len(inside))
    kept = np.ix_((grid >= 0).any(axis=1), (grid >= 0).any(axis=0))
    return plane.reshape(-1, 2)[np.sort(inside)], Mesh.from_grid(grid[kept])


def _triangulate(flat: Floats) -> Ints:
    """Return Delaunay triangles, counter-clockwise when v points down, without slivers on the border."""
    from scipy.spatial import Delaunay  # imported here because neither grids nor listing the examples need it

    triangles = Delaunay(flat).simplices.astype(np.int32)
    first, second = flat[triangles[:, 1]] - flat[triangles[:, 0]], flat[triangles[:, 2]] - flat[triangles[:, 0]]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    # With v pointing down, a positive area means clockwise order in the image.
    triangles[area > 0] = triangles[area > 0][:, ::-1]
    return np.asarray(triangles[np.abs(area) > 0.02 * np.median(np.abs(area))])


def _check(num_points: int, mesh: str) -> None:
    if num_points < MIN_POINTS:
        raise refusal("num_points", f"at least {MIN_POINTS}", num_points)
    if mesh not in ("grid", "triangles"):
        raise refusal("mesh", "'grid' or 'triangles'", mesh)

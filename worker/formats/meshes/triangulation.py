"""The default mesh: a Delaunay triangulation of the frame with most visible points, without long edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.solver import Mesh, Tracks

MAX_EDGE_RATIO = 5.0
"""Ratio of an edge to the median edge above which its triangles are removed: they bridge gaps and concave parts of the outline."""


def triangulate(tracks: Tracks, *, y_axis: str) -> tuple[Mesh | None, list[str]]:
    """Triangulate the points of the frame in which most are visible (the first such frame); return the mesh, and notes.

    Triangles with an edge longer than 5 times the median edge length are removed. Faces are counter-clockwise as seen from the
    camera. Points hidden in that frame have no face and so no spatial smoothness. There is no mesh when fewer than three points
    are visible at once or all lie on a line.
    """
    from scipy.spatial import Delaunay, QhullError  # not for inputs that need no triangulation

    frame = int(np.argmax((tracks.visible > 0).sum(axis=1)))
    seen = np.flatnonzero(tracks.visible[frame] > 0)
    points = tracks.points[frame, seen]
    try:
        triangles = Delaunay(points).simplices if len(seen) >= 3 else np.zeros((0, 3), dtype=np.intc)
    except QhullError:
        triangles = np.zeros((0, 3), dtype=np.intc)
    if len(triangles) == 0:
        return None, [
            f"No mesh was given and frame {frame} has too few distinct points to generate one; no smoothness in space."
        ]
    corners = points[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    limit = MAX_EDGE_RATIO * float(np.median(longest))
    kept = (longest <= limit).all(axis=1)
    faces = seen[_facing_camera(triangles[kept], points, y_axis)]
    mesh = Mesh.from_faces(faces.astype(np.int32), tracks.num_points)
    alone = tracks.num_points - len(np.unique(faces))
    notes = [
        f"No mesh was given: Delaunay triangulation of frame {frame}, where {len(seen)} of {tracks.num_points} points are visible; "
        f"{int((~kept).sum())} of {len(kept)} triangles with an edge over {MAX_EDGE_RATIO:g} × the median were removed."
    ]
    if alone:
        belong = "1 point belongs" if alone == 1 else f"{alone} points belong"
        notes.append(f"{belong} to no face of the generated mesh; smoothness in space has no effect there.")
    return mesh, notes


def _facing_camera(triangles: NDArray[np.intc], points: NDArray[np.float64], y_axis: str) -> NDArray[np.intc]:
    """Return faces with corners counter-clockwise for the viewer, whichever way y points."""
    one, two, three = (points[triangles[:, i]] for i in range(3))
    area = (two[:, 0] - one[:, 0]) * (three[:, 1] - one[:, 1]) - (two[:, 1] - one[:, 1]) * (three[:, 0] - one[:, 0])
    wrong = area < 0 if y_axis == "up" else area > 0
    turned = triangles.copy()
    turned[wrong] = triangles[wrong][:, ::-1]
    return turned

"""Geometry shared by writers: normals, axes, and a suitable scale for viewers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int32]


def upright(shapes: Floats, y_axis: str) -> Floats:
    """Rotate shapes to y up, right-handed: half a turn about x if y points down, so nothing is mirrored."""
    return shapes if y_axis == "up" else shapes * np.array([1.0, -1.0, -1.0])


def vertex_normals(points: Floats | Singles, triangles: Ints) -> Singles:
    """Return area-weighted unit normals `(P, 3)`; (0, 0, 1) for points without a face or with faces of zero area only."""
    one, two, three = (points[triangles[:, i]].astype(np.float64) for i in range(3))
    doubled = np.cross(two - one, three - one)
    total = np.zeros((len(points), 3))
    for axis in range(3):
        for corner in range(3):
            total[:, axis] += np.bincount(triangles[:, corner], doubled[:, axis], len(points))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    usable = length[:, 0] > 1e-12 * max(float(length.max(initial=0.0)), 1e-300)
    total[usable] /= length[usable]
    total[~usable] = (0.0, 0.0, 1.0)
    return total.astype(np.float32)


def viewer_scale(shapes: Floats) -> float:
    """Return the power of ten that scales the bounding box's diagonal to 1 … 10, for viewers that assume metres."""
    low, high = shapes.min(axis=(0, 1)), shapes.max(axis=(0, 1))
    diagonal = float(np.linalg.norm(high - low))
    return 1.0 if diagonal == 0 or not np.isfinite(diagonal) else float(10.0 ** -np.floor(np.log10(diagonal)))

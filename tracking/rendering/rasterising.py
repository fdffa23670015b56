"""A z-buffer for triangle meshes seen by a pinhole camera, in NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FRAGMENTS = 2_000_000
"""Candidate pixels tested at once; bounds the memory of one batch to about 200 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Visible surface of a mesh at each pixel of one frame."""

    triangle: Ints
    """Index of the nearest triangle, shape `(H, W)`; −1 where the mesh covers nothing."""

    weights: Floats
    """Barycentric coordinates on that triangle in space (not on screen), shape `(H, W, 3)`."""

    depth: Floats
    """Distance along the optical axis, shape `(H, W)`; infinity where the mesh covers nothing."""


def rasterise(pixels: Floats, depth: Floats, triangles: Ints, *, size: tuple[int, int]) -> Surface:
    """Find the nearest triangle at the centre of every pixel; both sides of a triangle are visible.

    `pixels (P, 2)` are the projected vertices, with the centre of pixel (0, 0) at (0, 0); `depth (P,)` is their positive distance
    along the optical axis; triangles are `(T, 3)`; `size` is width and height.
    """
    width, height = size
    pixel, triangle, screen = _fragments(pixels[triangles], width, height)
    # 1/Z is linear on the screen, so weights in space are screen weights over depth (perspective-correct interpolation).
    weights = screen / depth[triangles[triangle]]
    total = weights.sum(axis=1)
    weights /= total[:, None]
    far_to_near = np.lexsort((triangle, total))
    nearest = np.full(height * width, -1)
    nearest[pixel[far_to_near]] = far_to_near
    hit = np.flatnonzero(nearest >= 0)
    chosen = nearest[hit]
    surface = Surface(np.full(height * width, -1), np.zeros((height * width, 3)), np.full(height * width, np.inf))
    surface.triangle[hit], surface.weights[hit], surface.depth[hit] = (
        triangle[chosen],
        weights[chosen],
        1 / total[chosen],
    )
    return Surface(
        surface.triangle.reshape(height, width),
        surface.weights.reshape(height, width, 3),
        surface.depth.reshape(height, width),
    )


def _fragments(corners: Floats, width: int, height: int) -> tuple[Ints, Ints, Floats]:
    """Return pixel, triangle and screen barycentric coordinates of all covered pixels, processing triangles by size."""
    low = np.maximum(np.floor(corners.min(axis=1)), 0).astype(np.int64)
    high = np.minimum(np.ceil(corners.max(axis=1)), (width - 1, height - 1)).astype(np.int64)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    span = np.maximum((high - low).max(axis=1) + 1, 1)
    drawn = (np.abs(area) > 1e-12) & (high >= low).all(axis=1)
    level = np.ceil(np.log2(span)).astype(int)
    found: list[tuple[Ints, Ints, Floats]] = []
    for power in np.unique(level[drawn]):
        some = np.flatnonzero(drawn & (level == power))
        steps = np.stack(np.meshgrid(np.arange(2**power), np.arange(2**power)), axis=-1).reshape(-1, 2)
        for part in np.array_split(some, max(1, len(some) * len(steps) // FRAGMENTS)):
            place = low[part, None] + steps
            offset = place - corners[part, None, 0]
            a, b, det = first[part, None], second[part, None], area[part, None]
            u = (offset[..., 0] * b[..., 1] - offset[..., 1] * b[..., 0]) / det
            v = (a[..., 0] * offset[..., 1] - a[..., 1] * offset[..., 0]) / det
            weights = np.stack([1 - u - v, u, v], axis=-1)
            row, column = np.nonzero((weights >= -1e-9).all(axis=-1) & (place < (width, height)).all(axis=-1))
            found.append((place[row, column, 1] * width + place[row, column, 0], part[row], weights[row, column]))
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
    return (
        np.concatenate([part[0] for part in found]),
        np.concatenate([part[1] for part in found]),
        np.concatenate([part[2] for part in found]),
    )

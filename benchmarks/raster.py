"""A small software rasteriser: shaded, coloured meshes as arrays, with nothing but NumPy."""

from __future__ import annotations

import numpy as np

LIGHTS = (((-0.55, -0.65, -0.60), 0.52), ((0.80, -0.05, -0.60), 0.20), ((0.0, 0.0, -1.0), 0.22))
"""Directions towards the light (x right, y down, z away from the viewer) and strengths: a key, a fill, and one beside the eye."""
AMBIENT = 0.14
COLOURED = 0.45
"""Share of the shading that is kept where colours mean something, so that dark stays the scale's dark."""
SUPERSAMPLING = 2
GREY = 0.86


def draw_mesh(
    points: np.ndarray,
    faces: np.ndarray,
    *,
    size: tuple[int, int],
    scale: float,
    centre: tuple[float, float] = (0.0, 0.0),
    colours: np.ndarray | None = None,
    background: float = 1.0,
) -> np.ndarray:
    """Draw a mesh orthographically with smooth shading.

    Parameters
    ----------
    points : (P, 3) camera axes: x right, y down, z away from the viewer.
    faces : (T, 3) or (T, 4).
    size : (height, width) in pixels.
    scale : pixels per unit.
    centre : x, y of the point that is drawn in the middle.
    colours : (P, 3) in [0, 1]; grey when not given.

    Returns
    -------
    (height, width, 3) float in [0, 1].
    """
    fine = SUPERSAMPLING
    height, width = size[0] * fine, size[1] * fine
    triangles = split_quads(faces)
    normals = _vertex_normals(points, triangles)
    screen = (points[:, :2] - centre) * (scale * fine) + (width / 2, height / 2)
    pixel, triangle, inside = _fragments(screen[triangles], height, width)
    corner = triangles[triangle]
    depth = np.einsum("nk,nk->n", inside, points[corner, 2])
    order = np.argsort(-depth, kind="stable")  # far to near: the nearest is written last
    pixel, corner, inside = pixel[order], corner[order], inside[order]
    nearest = np.zeros(height * width, dtype=np.int64) - 1
    nearest[pixel] = np.arange(len(pixel))
    hit = nearest[nearest >= 0]
    normal = np.einsum("nk,nkc->nc", inside[hit], normals[corner[hit]])
    base = np.full((len(points), 3), GREY) if colours is None else colours
    colour = np.einsum("nk,nkc->nc", inside[hit], base[corner[hit]])
    light = _shade(normal) if colours is None else 1 + COLOURED * (_shade(normal) - 1)
    image = np.full((height * width, 3), background)
    image[pixel[hit]] = np.clip(colour * light[:, None], 0, 1)
    return image.reshape(size[0], fine, size[1], fine, 3).mean(axis=(1, 3))


def draw_points(
    points: np.ndarray,
    *,
    size: tuple[int, int],
    scale: float,
    centre: tuple[float, float] = (0.0, 0.0),
    colours: np.ndarray | None = None,
    radius: int = 1,
) -> np.ndarray:
    """Draw points as small squares, nearest (smallest z, where there is one) on top."""
    height, width = size
    image = np.ones((height, width, 3))
    order = np.argsort(-points[:, 2]) if points.shape[1] == 3 else np.arange(len(points))
    place = np.round((points[order, :2] - centre) * scale + (width / 2, height / 2)).astype(int)
    paint = np.full((len(points), 3), 0.25) if colours is None else colours[order]
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            x, y = place[:, 0] + right, place[:, 1] + down
            ok = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            image[y[ok], x[ok]] = paint[ok]
    return image


def split_quads(faces: np.ndarray) -> np.ndarray:
    """Triangles of a triangle or quad mesh."""
    return faces if faces.shape[1] == 3 else np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])


def _shade(normal: np.ndarray) -> np.ndarray:
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal = np.where(normal[:, 2:] > 0, -normal, normal)  # the back of a sheet is lit like its front
    light = np.full(len(normal), AMBIENT)
    for direction, strength in LIGHTS:
        towards = np.array(direction) / np.linalg.norm(direction)
        light += strength * np.maximum(normal @ towards, 0)
    return light


def _vertex_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corners = points[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = [np.bincount(triangles.ravel(), np.repeat(across[:, axis], 3), len(points)) for axis in range(3)]
    normals = np.stack(total, axis=1)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _fragments(corners: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel, triangle and barycentric coordinates of every covered pixel, going through triangles of one size at a time."""
    low = np.floor(corners.min(axis=1)).astype(int)
    span = np.ceil(corners.max(axis=1)).astype(int) - low
    edges = corners[:, 1:] - corners[:, :1]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    level = np.ceil(np.log2(np.maximum(span.max(axis=1), 1) + 1)).astype(int)
    found = []
    for power in np.unique(level):
        some = np.flatnonzero((level == power) & (np.abs(area) > 1e-12))
        steps = np.stack(np.meshgrid(np.arange(2**power), np.arange(2**power), indexing="xy"), axis=-1).reshape(-1, 2)
        for part in np.array_split(some, max(1, len(some) * len(steps) // 2_000_000)):
            place = low[part, None] + steps[None]
            offset = place + 0.5 - corners[part, None, 0]
            first, second = edges[part, None, 0], edges[part, None, 1]
            b = (offset[..., 0] * second[..., 1] - offset[..., 1] * second[..., 0]) / area[part, None]
            c = (first[..., 0] * offset[..., 1] - first[..., 1] * offset[..., 0]) / area[part, None]
            bary = np.stack([1 - b - c, b, c], axis=-1)
            ok = (bary >= -1e-9).all(axis=-1) & (place >= 0).all(axis=-1) & (place < (width, height)).all(axis=-1)
            row, column = np.nonzero(ok)
            found.append((place[row, column, 1] * width + place[row, column, 0], part[row], bary[row, column]))
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))  # type: ignore[return-value]

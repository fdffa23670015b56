"""Draw shaded, coloured meshes and points, using the tracker's rasteriser."""

from __future__ import annotations

import numpy as np
from pliant.solver.mesh import triangles_of
from pliant.tracking.rendering.rasterising import rasterise

LIGHTS = (((-0.55, -0.65, -0.60), 0.52), ((0.80, -0.05, -0.60), 0.20), ((0.0, 0.0, -1.0), 0.22))
"""Directions towards the light (x right, y down, z away from the viewer) and strengths: a key, a fill, and one beside the eye."""
AMBIENT = 0.14
COLOURED = 0.45
"""Share of the shading kept where colours encode values, so that shading is not mistaken for the dark end of the scale."""
SUPERSAMPLING = 2
GREY = 0.86
FAR = 1e6
"""Distance of the camera in depths of the drawn mesh."""


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
    """Draw a mesh orthographically with smooth shading; return `(height, width, 3)` in [0, 1].

    Points `(P, 3)` are in camera axes: x right, y down, z away from the viewer; `scale` is in pixels per unit, and `centre` is
    drawn in the middle. Colours `(P, 3)` are in [0, 1].
    """
    fine = SUPERSAMPLING
    height, width = size[0] * fine, size[1] * fine
    triangles = triangles_of(faces)
    normals = _vertex_normals(points, triangles)
    screen = (points[:, :2] - centre) * (scale * fine) + ((width - 1) / 2, (height - 1) / 2)
    # A distance of a million depths makes the rasteriser's perspective negligible.
    near = points[:, 2] - points[:, 2].min()
    shown = rasterise(screen, near + FAR * max(float(near.max()), 1e-9), triangles, size=(width, height))
    hit = np.flatnonzero(shown.triangle >= 0)
    corner, inside = triangles[shown.triangle.ravel()[hit]], shown.weights.reshape(-1, 3)[hit]
    normal = np.einsum("nk,nkc->nc", inside, normals[corner])
    base = np.full((len(points), 3), GREY) if colours is None else colours
    colour = np.einsum("nk,nkc->nc", inside, base[corner])
    light = _shade(normal) if colours is None else 1 + COLOURED * (_shade(normal) - 1)
    image = np.full((height * width, 3), background)
    image[hit] = np.clip(colour * light[:, None], 0, 1)
    return image.reshape(size[0], fine, size[1], fine, 3).mean(axis=(1, 3))


def draw_points(
    points: np.ndarray,
    *,
    size: tuple[int, int],
    scale: float,
    radius: int,
    colours: np.ndarray | None = None,
) -> np.ndarray:
    """Draw points as small squares, the nearest (smallest z, if there is one) on top; return `(height, width, 3)` in [0, 1]."""
    height, width = size
    image = np.ones((height, width, 3))
    order = np.argsort(-points[:, 2]) if points.shape[1] == 3 else np.arange(len(points))
    place = np.round(points[order, :2] * scale + (width / 2, height / 2)).astype(int)
    paint = np.full((len(points), 3), 0.25) if colours is None else colours[order]
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            x, y = place[:, 0] + right, place[:, 1] + down
            ok = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            image[y[ok], x[ok]] = paint[ok]
    return image


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

"""Render a short synthetic film in seconds: a textured face that talks and turns in front of a plain background.

`RenderedFilm` evaluates its solid texture at every sample, which takes about a second per frame. Here the texture is a picture, projected
onto the face from the front once.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.solver.gallery import face
from pliant.tracking.rendering.rasterising import rasterise
from pliant.tracking.rendering.rendered_film import RenderedFilm, render_film, texture

FRAMES = 30
POINTS = 3000
DEGREES = 45.0
"""Turn of the face: enough to determine its depth."""

SIZE = (480, 360)
FPS = 15.0
NOISE = 1.5
"""Standard deviation of the noise, grey levels."""

BACKGROUND = (196.0, 201.0, 206.0)
"""RGB; plain, so that tracking the whole picture tracks only the face."""

OUTLINE_TOLERANCE = 2.0
"""Maximum distance of the region from the face's outline, px."""

MARGIN = 8
"""Pixels of texture beyond the face, so that its rim is not interpolated with the picture's border."""


def write_example_film(path: Path | str) -> Path:
    """Render and encode the film; the suffix decides the container, see `RenderedFilm.write`."""
    film = _film()
    picture, low = _front(film)
    return film.write(path, fps=FPS, frame=lambda index: _frame(film, index, picture, low))


def example_region() -> list[list[float]]:
    """Return the corners of the face in the film's first frame, as the option `region_polygon` takes them."""
    outline = cv2.convexHull(_film().pixels[0].astype(np.float32))
    corners = cv2.approxPolyDP(outline, OUTLINE_TOLERANCE, closed=True).reshape(-1, 2).astype(np.float64)
    return [[round(float(x), 1), round(float(y), 1)] for x, y in corners]


def _film() -> RenderedFilm:
    return render_film(face(FRAMES, POINTS, degrees=DEGREES), size=SIZE, distance=8.0, fill=0.85)


def _front(film: RenderedFilm) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the texture `(H, W, 3)` of the face seen from the front, and the position of its upper left corner."""
    low = film.rest[:, :2].min(axis=0) - MARGIN
    width, height = np.ceil(film.rest[:, :2].max(axis=0) + MARGIN - low).astype(int)
    x, y = np.meshgrid(np.arange(width) + low[0], np.arange(height) + low[1])
    places = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    skin = np.array([1.05, 0.88, 0.78]) * (60 + 0.75 * texture(places, film.size[1], film.seed))
    return skin.reshape(height, width, 3).astype(np.float32), low


def _frame(film: RenderedFilm, index: int, picture: NDArray[np.float32], low: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Render one frame, shape `(H, W, 3)`, RGB."""
    surface = rasterise(film.pixels[index], film.shapes[index, :, 2], film.triangles, size=film.size)
    covered = surface.triangle >= 0
    corners = film.rest[film.triangles[surface.triangle], :2]
    at = (np.einsum("hwk,hwkc->hwc", surface.weights, corners) - low).astype(np.float32)
    shown = cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    image = np.where(covered[..., None], shown, np.array(BACKGROUND, dtype=np.float32))
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    grain = np.random.default_rng((film.seed, index)).standard_normal(image.shape)
    return np.asarray(np.clip(np.round(image + NOISE * grain), 0, 255), dtype=np.uint8)

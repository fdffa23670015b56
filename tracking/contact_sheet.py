"""Draw tracks over some frames of their film, to judge them at a glance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.solver.storage import let_go

if TYPE_CHECKING:
    from pliant.tracking.records import TrackedFilm

COLUMNS = 3
ACROSS = 20
"""Approximate number of points drawn across the region; all points would hide the picture."""

TAIL = 6
"""Number of past frames of each track that are drawn."""

QUALITY = 85
"""JPEG quality of the sheet."""

View = tuple[int, int, int, int]
"""A rectangle of the picture: first column and row, width and height in pixels of the film."""

MARGIN = 0.15
"""Width of the surroundings that are shown on every side of the points, share of the points' extent."""


def view_of(tracks: NDArray[np.float32], visible: NDArray[np.bool_], size: tuple[int, int]) -> View:
    """Return the smallest rectangle with the picture's aspect ratio that shows all visible points of all frames, and a margin."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for points, seen in zip(tracks, visible, strict=True):  # one frame at a time, to save memory
        low = points.min(axis=0, where=seen[:, None], initial=np.inf).clip(max=low)
        high = points.max(axis=0, where=seen[:, None], initial=-np.inf).clip(min=high)
        let_go(tracks, visible)
    whole = np.array(size)
    share = min(1.0, float(((high - low + 1) * (1 + 2 * MARGIN) / whole).max()))
    extent = np.maximum(1, np.round(share * whole)).astype(int)
    start = np.clip(np.round((low + high + 1 - extent) / 2), 0, whole - extent).astype(int)
    return int(start[0]), int(start[1]), int(extent[0]), int(extent[1])


def draw_contact_sheet(film: TrackedFilm, *, png: bool = False) -> bytes:
    """Draw visible points and their last steps over every thumbnail; return a JPEG or a PNG.

    A point's colour encodes its position in the template, so that a surface point has the same colour in all pictures.
    """
    frames = [int(frame) for frame in film.thumbnail_frames]
    colours = _colours(film.tracks[film.template])
    pictures = [_draw(picture, frame, film, colours) for picture, frame in zip(film.thumbnails, frames, strict=True)]
    columns = min(COLUMNS, len(pictures))
    pictures += [np.zeros_like(pictures[0])] * (-len(pictures) % columns)
    rows = [np.hstack(pictures[start : start + columns]) for start in range(0, len(pictures), columns)]
    whole = cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR)
    return bytes(
        cv2.imencode(".png" if png else ".jpg", whole, [] if png else [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
    )


def _draw(picture: NDArray[np.uint8], frame: int, film: TrackedFilm, colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    canvas = picture.copy()
    left, top, width, height = film.thumbnail_view
    scale = canvas.shape[1] / width, canvas.shape[0] / height
    every = max(1, round(float(np.sqrt((film.grid >= 0).sum())) / ACROSS))
    row, column = np.nonzero(film.grid >= 0)
    chosen = np.sort(film.grid[row, column][(row % every == 0) & (column % every == 0)])
    rows = slice(max(0, frame - TAIL), frame + 1)
    paths = np.clip((film.tracks[rows, chosen] - (left, top) + 0.5) * scale - 0.5, -1e4, 1e4)
    seen = film.visibility[rows, chosen]
    for number in np.flatnonzero(seen[-1]):
        colour = tuple(int(level) for level in colours[chosen[number]])
        path = np.round(paths[seen[:, number], number] * 16).astype(np.int32)
        cv2.polylines(canvas, [path[:, None]], False, colour, 1, cv2.LINE_AA, 4)
        cv2.circle(canvas, tuple(int(value) for value in path[-1]), 22, colour, -1, cv2.LINE_AA, 4)
    time = f"{film.frame_times[frame]:.2f} s"
    for shade, width in ((0, 3), (255, 1)):
        cv2.putText(
            canvas, time, (6, canvas.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (shade,) * 3, width, cv2.LINE_AA
        )
    return canvas


def _colours(points: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return RGB colours `(P, 3)`: hue from the angle around the template points' centre, saturation from the distance to it."""
    offset = points - points.mean(axis=0)
    angle = np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) % 1.0
    radius = np.linalg.norm(offset, axis=1)
    hsv = np.stack([angle * 179, 90 + 165 * radius / max(radius.max(), 1e-6), np.full(len(angle), 255.0)], axis=1)
    return np.asarray(cv2.cvtColor(hsv.astype(np.uint8)[None], cv2.COLOR_HSV2RGB)[0], dtype=np.uint8)


def small_jpeg(image: NDArray[np.uint8], *, longest_side: int, quality: int) -> bytes:
    """Return an RGB picture `(H, W, 3)` as a JPEG whose longest side is at most `longest_side` pixels."""
    scale = longest_side / max(image.shape[:2])
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)[1].tobytes())

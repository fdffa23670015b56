"""Tracks drawn over some frames of their film, to judge them at a glance."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.tracking.records import TrackedFilm

COLUMNS = 3
TAIL = 6
"""Frames of each track's past that are drawn."""


def draw_contact_sheet(tracked: TrackedFilm, *, quality: int = 85) -> bytes:
    """Draw visible points and their last steps over every thumbnail; returns a JPEG.

    A point's colour is its place in the template, so that the same surface has the same colour in all pictures.
    """
    pictures = [
        _draw(picture, int(frame), tracked)
        for picture, frame in zip(tracked.thumbnails, tracked.thumbnail_frames, strict=True)
    ]
    columns = min(COLUMNS, len(pictures))
    blank = np.zeros_like(pictures[0])
    pictures += [blank] * (-len(pictures) % columns)
    rows = [np.hstack(pictures[start : start + columns]) for start in range(0, len(pictures), columns)]
    sheet = cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes())


def _draw(picture: NDArray[np.uint8], frame: int, tracked: TrackedFilm) -> NDArray[np.uint8]:
    canvas = picture.copy()
    scale = canvas.shape[1] / tracked.film.size[0]
    spacing = float(np.sqrt(max(len(tracked.faces), 1)))
    colours = _colours(tracked)
    # About 30 points across: every point would hide the picture.
    every = max(1, round(spacing / 30))
    row, column = np.nonzero(tracked.grid >= 0)
    chosen = np.sort(tracked.grid[row, column][(row % every == 0) & (column % every == 0)])
    first = max(0, frame - TAIL)
    paths = np.clip((tracked.tracks[first : frame + 1, chosen] + 0.5) * scale - 0.5, -1e4, 1e4)
    seen = tracked.visibility[first : frame + 1, chosen]
    for number, point in enumerate(chosen):
        if not seen[-1, number]:
            continue
        colour = tuple(int(level) for level in colours[point])
        path = np.round(paths[seen[:, number], number] * 16).astype(np.int32)
        cv2.polylines(canvas, [path[:, None]], False, colour, 1, cv2.LINE_AA, 4)
        cv2.circle(canvas, tuple(int(value) for value in path[-1]), 20, colour, -1, cv2.LINE_AA, 4)
    time = f"{tracked.film.frame_times[frame]:.2f} s"
    for shade, width in ((0, 3), (255, 1)):
        cv2.putText(
            canvas, time, (6, canvas.shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (shade,) * 3, width, cv2.LINE_AA
        )
    return canvas


def _colours(tracked: TrackedFilm) -> NDArray[np.uint8]:
    """Hue by the angle around the middle of the template's points, saturation by the distance, shape `(P, 3)`, RGB."""
    offset = tracked.tracks[tracked.template] - tracked.tracks[tracked.template].mean(axis=0)
    angle = np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) % 1.0
    radius = np.linalg.norm(offset, axis=1)
    hsv = np.stack([angle * 179, 90 + 165 * radius / max(radius.max(), 1e-6), np.full(len(angle), 255.0)], axis=1)
    return np.asarray(cv2.cvtColor(hsv.astype(np.uint8)[None], cv2.COLOR_HSV2RGB)[0], dtype=np.uint8)

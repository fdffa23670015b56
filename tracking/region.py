"""The region to track, from a mask picture or a polygon, and its transport to another frame."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, UnidentifiedImageError
from pliant.tracking.appearance import Appearance
from pliant.tracking.errors import FilmError, TrackingStopped
from pliant.tracking.flow import Bools, Floats, Grey, dense_flow, match
from pliant.tracking.records import OnStep, TrackingStep
from pliant.tracking.seeding import Seeds, neighbours, quads

Region = NDArray[np.bool_] | NDArray[np.uint8] | Sequence[Sequence[float]] | Path | str

DARK, LIGHT = 32, 223
"""Levels of 0 to 255 up to which a pixel of a mask is black, and above which it is white: JPEG compression changes either by less."""

LARGEST_OUTLINE = 0.02
"""Share of a picture's pixels that may always be between black and white.

More may be if they are at most twice as many as the white and as the black ones. Anti-aliased, JPEG-compressed and feathered outlines
(standard deviation up to 2 % of the width, of discs 0.1 to 0.97 of the picture's height) keep to that; photographs and drawings do not.
"""

LONG_STEP = 2
"""Frames per step when a region is carried to the template; longer steps lose fast motion."""


def read_region(region: Region, size: tuple[int, int]) -> Bools:
    """Convert a region to a mask, shape `(H, W)`.

    The region is the path of a mask picture of the film's size, an array `(H, W)` (bool, or uint8 with 128 and above inside), or a polygon
    of pixels `(N, 2)` with N ≥ 3. In pictures with transparency, opaque pixels are inside. Pictures must be black and white, except for a
    soft outline.

    Raises
    ------
    FilmError
        Not a mask or polygon, not black and white, another size than the film's, or empty.
    """
    if isinstance(region, str | Path):
        mask = _from_picture(Path(region), size)
    else:
        try:
            given = np.asarray(region)
        except ValueError:
            given = np.full((1, 2), np.nan)  # rows of several lengths
        polygon = given.ndim == 2 and given.shape[1] == 2 and given.dtype != bool and given.shape != size[::-1]
        mask = _from_polygon(given, size) if polygon else _from_array(given)
    if mask.shape != size[::-1]:
        raise _refusal(
            "wrong_region_size", f"a mask of {size[0]}×{size[1]} pixels, the film's size",
            f"{mask.shape[1]}×{mask.shape[0]}", "Draw the region on a frame of this film, upright as it is shown.",
        )  # fmt: skip
    if not mask.any():
        raise _refusal("empty_region", "some pixels inside", "none", "Draw around the object to track.")
    return mask


def transport(
    read: Callable[[int], Grey],
    region: Bools,
    seeds: Seeds,
    start: int,
    end: int,
    *,
    pool: ThreadPoolExecutor,
    on_step: OnStep,
    should_stop: Callable[[], bool],
) -> Bools:
    """Carry a region `(H, W)` from one frame to another and return its mask there.

    The grid's points are carried directly from the start and, in steps, from frame to frame; the more certain result is taken, as in
    `chaining`. The mask is the union of the faces whose corners are all visible, closed over one grid step.
    """
    points, seen = seeds.points, np.ones(len(seeds.points), dtype=bool)
    variance = np.zeros(len(points), dtype=np.float32)
    appearance = Appearance.of(read(start), region, seeds.points, neighbours(seeds.grid, len(points)))
    direction = 1 if end > start else -1
    stations = [*range(start, end, direction * LONG_STEP), end]
    for before, here in itertools.pairwise(stations):
        on_step(TrackingStep("locate", abs(before - start), abs(end - start)))
        if should_stop():
            raise TrackingStopped
        ways = [(start, seeds.points, np.ones_like(seen), np.zeros_like(variance)), (before, points, seen, variance)]
        frame = read(here)
        flows = [
            (pool.submit(dense_flow, read(way[0]), frame), pool.submit(dense_flow, frame, read(way[0]))) for way in ways
        ]
        found = [match(there.result(), back.result(), way[1]) for way, (there, back) in zip(ways, flows, strict=True)]
        sees = np.stack([way[2] & ~m.lost for way, m in zip(ways, found, strict=True)])
        sums = np.stack([way[3] + m.gap for way, m in zip(ways, found, strict=True)])
        best = np.lexsort((sums, ~sees), axis=0)[0]
        every = np.arange(len(best))
        points = np.stack([m.points for m in found])[best, every]
        seen, variance = appearance.agrees(frame, points, sees[best, every]), sums[best, every]
    return _cover(points, seen, seeds, read(end).shape)


def _cover(points: Floats, seen: Bools, seeds: Seeds, shape: tuple[int, ...]) -> Bools:
    """Fill the faces whose corners are all visible, and close gaps of one grid step."""
    mask = np.zeros(shape, dtype=np.uint8)
    faces = quads(seeds.grid)
    corners = np.round(points[faces[seen[faces].all(axis=1)]]).astype(np.int32)
    for corner in corners:
        cv2.fillConvexPoly(mask, corner, 1)
    step = int(np.ceil(np.abs(seeds.points[faces[:, 2]] - seeds.points[faces[:, 0]]).max())) if len(faces) else 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * step + 1, 2 * step + 1))
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disc) > 0)


def _from_picture(path: Path, size: tuple[int, int]) -> Bools:
    try:
        with Image.open(path, formats=("PNG", "JPEG", "WEBP", "BMP", "GIF")) as picture:
            if picture.size != size:
                return np.zeros(picture.size[::-1], dtype=bool)  # rejected for its size without being decoded
            if picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info:
                alpha = np.asarray(picture.convert("RGBA"))[..., 3]
                if alpha.min() < 128:
                    return _from_levels(alpha)
            return _from_levels(np.asarray(picture.convert("L")))
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise _refusal(
            "unreadable_region", "a PNG, JPEG, WebP, BMP or GIF picture", f"{path.name}: {error}",
            "Save the mask as PNG: white inside, black outside.",
        ) from error  # fmt: skip


def _from_array(given: NDArray[np.generic]) -> Bools:
    if given.ndim != 2 or given.dtype not in (np.dtype(bool), np.dtype(np.uint8)):
        raise _refusal(
            "wrong_region", "a mask (H, W) of bool or uint8, or a polygon (N, 2) with N ≥ 3",
            f"shape {given.shape}, dtype {given.dtype}", "Convert the array.",
        )  # fmt: skip
    return np.asarray(given if given.dtype == bool else np.asarray(given, dtype=np.uint8) >= 128, dtype=bool)


def _from_levels(levels: NDArray[np.uint8]) -> Bools:
    """Return the pixels of a picture that are white.

    Raises
    ------
    FilmError
        The picture is not black and white.
    """
    black, white = float((levels <= DARK).mean()), float((levels > LIGHT).mean())
    between = 1 - black - white
    if between > max(LARGEST_OUTLINE, 2 * min(black, white)):
        raise _refusal(
            "wrong_region", "a black and white mask", f"a picture in which {between:.0%} of the pixels are in between",
            "Paint the object white and everything else black.",
        )  # fmt: skip
    return np.asarray(levels >= 128)


def _from_polygon(given: ArrayLike, size: tuple[int, int]) -> Bools:
    try:
        corners = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.full((1, 2), np.nan)
    if len(corners) < 3 or not np.isfinite(corners).all() or np.abs(corners).max() > 1e6:
        raise _refusal(
            "wrong_polygon", "a polygon of at least 3 corners with finite pixel coordinates",
            f"{len(corners)} corners", "Draw around the object to track.",
        )  # fmt: skip
    mask = np.zeros(size[::-1], dtype=np.uint8)
    cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], 1)
    return np.asarray(mask > 0)


def _refusal(code: str, expected: str, got: str, hint: str) -> FilmError:
    return FilmError(code, field="region", expected=expected, got=got, hint=hint)

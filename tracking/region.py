"""The region to track, from a mask picture or a polygon, and its transport to another frame."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, UnidentifiedImageError
from pliant.tracking.appearance import Appearance
from pliant.tracking.decoding.pictures import upright
from pliant.tracking.errors import FilmError, TrackingStopped
from pliant.tracking.flow import Bools, Floats, Grey, best_of, dense_flow, match
from pliant.tracking.records import OnStep, TrackingStep
from pliant.tracking.seeding import Seeds, default_step, neighbours

Region = NDArray[np.bool_] | NDArray[np.uint8] | Sequence[Sequence[float]] | Path | str

DARK, LIGHT = 32, 223
"""Levels of 0 to 255 up to which a pixel of a mask is black, and above which it is white: JPEG compression changes either by less."""

LARGEST_OUTLINE = 0.02
"""Share of a picture's pixels that may always be between black and white.

More may be if they are at most twice as many as the white and as the black ones. Anti-aliased, JPEG-compressed and feathered outlines
(standard deviation up to 2 % of the width, of discs 0.1 to 0.97 of the picture's height) keep to that; photographs and drawings do not.
"""

INSIDE = 128
"""Level of 0 to 255 from which a pixel of a mask is inside: the middle of an outline."""

FARTHEST = 1e6
"""Largest coordinate of a polygon's corner, pixels: OpenCV fills polygons in 32-bit fixed point. No film is larger."""

LONG_STEP = 2
"""Frames per step when a region is carried to the template; longer steps lose fast motion."""

REACH = 1.5
"""Distance from the nearest visible point up to which a pixel of the region moves with it, in steps of the grid: just beyond the diagonal
of a cell, so that the border of the region moves too."""


def read_region(region: Region, size: tuple[int, int]) -> Bools:
    """Convert a region to a mask, shape `(H, W)`.

    The region is the path of a mask picture of the film's size, an array `(H, W)` (bool, or uint8 with 128 and above inside, or of
    0 and 1), or a polygon of pixels `(N, 2)` with N ≥ 3, whose outline may cross itself. In pictures with transparency, opaque pixels are
    inside. Pictures must be black and white, except for a soft outline; as the film's own, they are turned by their EXIF orientation.

    Raises
    ------
    FilmError
        Not a mask or polygon, not black and white, another size than the film's, or empty.
    """
    if isinstance(region, str | Path):
        levels = _from_picture(Path(region), size)
    else:
        try:
            given = np.asarray(region)
        except ValueError as error:
            raise _wrong_polygon("rows of several lengths") from error
        polygon = given.ndim == 2 and given.shape[1] == 2 and given.dtype != bool and given.shape != size[::-1]
        levels = _from_polygon(given, size) if polygon else _from_array(given)
    mask = np.asarray(levels >= INSIDE)
    if mask.shape != size[::-1]:
        raise _refusal(
            "wrong_region_size", f"a mask of {size[0]}×{size[1]} pixels, the film's size",
            f"{mask.shape[1]}×{mask.shape[0]}", "Draw the region on a frame of this film, upright as it is shown.",
        )  # fmt: skip
    if not mask.any():
        brightest = int(levels.max(initial=0))
        got = "none" if brightest == 0 else f"none: the brightest level is {brightest}, of 255"
        raise _refusal(
            "empty_region", "some pixels inside", got,
            "Draw around the object to track." if brightest == 0 else f"Levels of {INSIDE} and above are inside: make the object white.",
        )  # fmt: skip
    return mask


def resized(region: Bools, shape: tuple[int, ...]) -> Bools:
    """Scale a mask to the height and width of other pictures."""
    levels = region.astype(np.uint8) * 255
    return np.asarray(cv2.resize(levels, (shape[1], shape[0]), interpolation=cv2.INTER_AREA) >= INSIDE)


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
) -> Iterator[tuple[int, Bools]]:
    """Carry a region `(H, W)` from one frame to another; yield frames on the way, at last the other one, and its mask in each.

    The grid's points are carried directly from the start and in steps of at most `LONG_STEP` frames. Of two visible results, the one with
    the smaller sum of squared cycle errors is taken; unlike in `chaining`, steps add no variance of their own. Every pixel of the region
    moves with the nearest visible point, if that is near, and gaps of one grid step are closed.
    """
    points, seen = seeds.points, np.ones(len(seeds.points), dtype=bool)
    variance = np.zeros(len(points), dtype=np.float32)
    appearance = Appearance.of(read(start), region, seeds.points, neighbours(seeds.grid, len(points)))
    direction = 1 if end > start else -1
    stations = [*range(start, end, direction * LONG_STEP), end]
    for before, here in itertools.pairwise(stations):
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
        points, seen, variance = best_of(found, sees, sums)
        seen = appearance.agrees(frame, points, seen)
        on_step(TrackingStep("locate", abs(here - start), abs(end - start)))
        yield here, _cover(region, seeds.points[seen], points[seen], default_step(region), frame.shape)


def _cover(region: Bools, before: Floats, after: Floats, step: float, shape: tuple[int, ...]) -> Bools:
    """Move the pixels of a region with the nearest of the points, from `before (N, 2)` to `after`, and close gaps of one grid step."""
    mask = np.zeros(shape, dtype=np.uint8)
    if len(before) == 0:
        return mask > 0
    x, y = np.round(before).astype(np.int64).T
    others = np.ones(shape, dtype=np.uint8)
    others[y, x] = 0
    distance, label = cv2.distanceTransformWithLabels(others, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    number = np.zeros(label.max() + 1, dtype=np.int64)  # of the point, by label
    number[label[y, x]] = np.arange(len(before))
    pixels = np.argwhere(region & (distance <= REACH * step))
    moved = (after - before)[number[label[tuple(pixels.T)]]]
    x, y = np.round(pixels[:, ::-1] + moved).astype(np.int64).T
    inside = (x >= 0) & (y >= 0) & (x < shape[1]) & (y < shape[0])
    mask[y[inside], x[inside]] = 1
    side = 2 * int(np.ceil(step)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disc) > 0)


def _from_picture(path: Path, size: tuple[int, int]) -> Grey:
    try:
        if path.exists() and not path.is_file():
            raise OSError("a folder, a pipe or a device")
        with Image.open(path, formats=("PNG", "JPEG", "WEBP", "BMP", "GIF")) as picture:
            if sorted(picture.size) != sorted(size):
                return np.zeros(picture.size[::-1], dtype=np.uint8)  # rejected for its size without being decoded
            turned = upright(picture)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        fault = "its format is not recognised" if isinstance(error, UnidentifiedImageError) else error
        raise _refusal(
            "unreadable_region", "a PNG, JPEG, WebP, BMP or GIF picture", f"{path.name}: {fault}",
            "Save the mask as PNG: white inside, black outside.",
        ) from error  # fmt: skip
    if turned.mode in ("RGBA", "LA", "PA") or "transparency" in turned.info:
        alpha = np.asarray(turned.convert("RGBA"))[..., 3]
        if alpha.min() < INSIDE:
            return _black_and_white(alpha)
    return _black_and_white(np.asarray(turned.convert("L")))


def _from_array(given: NDArray[np.generic]) -> Grey:
    if given.ndim != 2 or given.dtype not in (np.dtype(bool), np.dtype(np.uint8)):
        raise _refusal(
            "wrong_region", "a mask (H, W) of bool or uint8, or a polygon (N, 2) with N ≥ 3",
            f"shape {given.shape}, dtype {given.dtype}", "Convert the array.",
        )  # fmt: skip
    levels = np.asarray(given, dtype=np.uint8)
    # Segmentation models return 0 and 1.
    return levels * np.uint8(255) if levels.max(initial=0) == 1 else levels


def _black_and_white(levels: Grey) -> Grey:
    """Return the levels of a picture after checking them.

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
    return levels


def _from_polygon(given: ArrayLike, size: tuple[int, int]) -> Grey:
    try:
        corners = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise _wrong_polygon("corners that are no numbers") from error
    if len(corners) < 3:
        raise _wrong_polygon(f"{len(corners)} corners")
    far = np.flatnonzero(~(np.abs(corners) <= FARTHEST).all(axis=1))  # NaN as well
    if far.size:
        raise _wrong_polygon("the corner ({:g}, {:g})".format(*corners[far[0]]))
    along, across = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
    if across <= 1e-6 * along:
        raise _wrong_polygon("corners on one line")
    outline = np.round(corners).astype(np.int64)
    mask = np.where(_turns(outline, size) != 0, 255, 0).astype(np.uint8)
    cv2.fillPoly(mask, [outline.astype(np.int32)], 255)  # adds the outline itself
    if not mask.any():
        low, high = corners.min(axis=0), corners.max(axis=0)
        raise _refusal(
            "empty_region", f"a polygon around some pixels of the film, which has {size[0]}×{size[1]}",
            f"x from {low[0]:g} to {high[0]:g} and y from {low[1]:g} to {high[1]:g}, outside the picture",
            "Give corners in the film's own pixels, not in those of an enlarged picture.",
        )  # fmt: skip
    return mask


def _turns(outline: NDArray[np.int64], size: tuple[int, int]) -> NDArray[np.int64]:
    """Return how often an outline `(N, 2)` runs around each pixel, shape `(H, W)`: twice where a drawn line overlaps itself."""
    width, height = size
    steps = np.zeros((height, width + 1), dtype=np.int64)
    for (x0, y0), (x1, y1) in zip(outline.tolist(), np.roll(outline, -1, axis=0).tolist(), strict=True):
        rows = np.arange(max(min(y0, y1), 0), min(max(y0, y1), height))
        if len(rows):
            crossings = np.ceil(x0 + (rows - y0) * ((x1 - x0) / (y1 - y0))).astype(np.int64)
            steps[rows, crossings.clip(0, width)] += 1 if y1 > y0 else -1
    return np.cumsum(steps, axis=1)[:, :width]


def _wrong_polygon(got: str) -> FilmError:
    expected = f"a polygon of at least 3 corners around an area, with finite pixel coordinates up to {FARTHEST:,.0f}"
    return _refusal("wrong_polygon", expected, got, "Draw around the object to track.")


def _refusal(code: str, expected: str, got: str, hint: str) -> FilmError:
    return FilmError(code, field="region", expected=expected, got=got, hint=hint)

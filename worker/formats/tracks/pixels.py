"""Conversion of coordinates to pixels: fractions of the picture, order of x and y, and projection of points in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.solver.limits import MAX_COORDINATE
from pliant.worker.formats.errors import AmbiguousInput

MAX_COMPARED = 100_000
"""Number of positions, roughly, that the interpretation of coordinates looks at."""
SLACK = 0.02
FRACTIONS = ("unit", "signed")
"""Kinds of coordinates that are fractions of the picture."""
MIN_INSIDE_SHARE = 0.9
"""Share of points that must be inside the picture for coordinates to count as fractions of it; none may be a picture size outside."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Points with the same unit for x and y."""

    points: NDArray[np.generic]
    """Shape `(F, P, 2)`, x first."""

    coordinates: str
    """Original unit: `pixels` (or another common unit), `unit` or `signed`."""

    notes: list[str]


def place(
    points: NDArray[np.generic], visible: NDArray[np.float64] | None, options: Options, *,
    picture: tuple[int, int] | None = None,
) -> Placed:  # fmt: skip
    """Convert fractions of the picture to pixels, and the coordinate order to x, y, by the visible points.

    `picture` is its width and height, if the points are all its pixels.

    Raises
    ------
    InvalidInput
        Code missing_image_size.
    AmbiguousInput
        Code ambiguous_coordinates: values from 0 to 1, which may be fractions of a picture or another unit.
    """
    size = options.picture_size
    sample = sampled(points, visible)
    points, sample, notes = _ordered(points, sample, options, size)
    kind, why = _kind(sample, options, size or picture)
    if kind == "pixels":
        return Placed(points, kind, notes + why)
    size = size or picture
    if size is None:
        raise InvalidInput(
            "missing_image_size", field="options.image_size", expected="the picture's WIDTHxHEIGHT, since coordinates are fractions of it",
            got="none", hint="Set it, e.g. image_size=640x480.",
        )  # fmt: skip
    last = np.array([size[0] - 1, size[1] - 1], dtype=np.float64)
    wide = np.asarray(points, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        placed = wide * last if kind == "unit" else (wide + 1.0) * (last / 2.0)
    return Placed(placed, kind, [*notes, *why, f"Converted to pixels of a picture of {size[0]} × {size[1]}."])


def project(
    points: NDArray[np.generic], intrinsics: NDArray[np.generic] | None
) -> tuple[NDArray[np.float64], str, list[str]]:
    """Project points in camera coordinates: x = fx X / Z + cx, y = fy Y / Z + cy; NaN for points behind the camera.

    X is right, Y down, Z ahead of the camera; `intrinsics` are fx, fy, cx, cy in pixels, or a matrix `(3, 3)`.

    Raises
    ------
    InvalidInput
        Code missing_array or wrong_shape.
    """
    if intrinsics is None:
        raise InvalidInput(
            "missing_array", field="tracks.intrinsics", expected="fx, fy, cx, cy beside points in space", got="none",
            hint="Save intrinsics=[fx, fy, cx, cy], or the image points as tracks (F, P, 2).",
        )  # fmt: skip
    matrix = np.asarray(intrinsics)
    if matrix.shape == (3, 3):
        matrix = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    if (
        matrix.size != 4
        or matrix.dtype.kind not in "fiu"
        or not np.isfinite(matrix).all()
        or (matrix.flat[:2] == 0).any()
    ):
        raise InvalidInput(
            "wrong_shape", field="tracks.intrinsics", expected="four finite numbers fx, fy, cx, cy, or a 3 × 3 matrix",
            got=f"{matrix.dtype} {matrix.shape}", hint="Save intrinsics=[fx, fy, cx, cy].",
        )  # fmt: skip
    fx, fy, cx, cy = (float(value) for value in matrix.reshape(-1))
    wide = np.asarray(points, dtype=np.float64)
    depth = np.where(wide[..., 2] > 0, wide[..., 2], np.nan)
    with np.errstate(over="ignore", invalid="ignore"):
        seen = np.stack([fx * wide[..., 0] / depth + cx, fy * wide[..., 1] / depth + cy], axis=-1)
    note = f"Points in space, projected with fx = {fx:g}, fy = {fy:g}, cx = {cx:g}, cy = {cy:g}; the points are used as ground truth."
    return seen, "projected", [note]


def sampled(points: NDArray[np.generic], visible: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return some of the visible positions, `(N, 2)`: trackers write any numbers, such as −1, where a point is hidden."""
    every = slice(None, None, max(1, points.shape[0] * points.shape[1] // MAX_COMPARED))
    flat = points.reshape(-1, 2)[every].astype(np.float64)
    used = (np.abs(flat) <= MAX_COORDINATE).all(axis=1)
    return flat[used if visible is None else used & (visible.reshape(-1)[every] > 0)]


def _ordered(
    points: NDArray[np.generic], sample: NDArray[np.float64], options: Options, size: tuple[int, int] | None
) -> tuple[NDArray[np.generic], NDArray[np.float64], list[str]]:
    turned, notes = options.coordinate_order == "yx", []
    if turned:
        notes = ["Coordinates read as y, x, as set by coordinate_order."]
    elif options.coordinate_order == "auto" and size is not None and len(sample):
        inside = [(sample <= np.array(limits)).all(axis=1).mean() for limits in (size, size[::-1])]
        turned = bool(inside[0] < MIN_INSIDE_SHARE and inside[1] >= 0.99)
        if turned:
            notes = [
                f"Coordinates read as y, x: {inside[1]:.0%} of them lie inside {size[0]} × {size[1]}, but only {inside[0]:.0%} as x, y."
            ]
    return (points[..., ::-1], sample[:, ::-1], notes) if turned else (points, sample, notes)


def _kind(sample: NDArray[np.float64], options: Options, size: tuple[int, int] | None) -> tuple[str, list[str]]:
    if options.coordinates != "auto":
        return options.coordinates, [f"Coordinates read as {options.coordinates}, as set by coordinates."]
    if not len(sample) or not (np.ptp(sample, axis=0) > 0).any():
        return "pixels", []
    low, high = sample.min(axis=0), sample.max(axis=0)
    observed = f"values from {low.min():.3g} to {high.max():.3g}"
    if low.min() >= -1 and high.max() <= 2 and _inside(sample, 0.0, 1.0) >= MIN_INSIDE_SHARE:
        if size is None:
            raise _fractions_or_not(observed)
        return "unit", [f"Coordinates are fractions of the picture: {observed}."]
    if (
        size is not None
        and min(size) > 4
        and low.min() >= -3
        and high.max() <= 3
        and _inside(sample, -1.0, 1.0) >= MIN_INSIDE_SHARE
    ):
        return "signed", [f"Coordinates run from −1 to 1 over the picture: {observed}."]
    return "pixels", []


def _inside(sample: NDArray[np.float64], low: float, high: float) -> float:
    return float(((sample >= low - SLACK) & (sample <= high + SLACK)).all(axis=1).mean())


def _fractions_or_not(observed: str) -> AmbiguousInput:
    choices: list[dict[str, Any]] = [
        {
            "layout": "fractions of the picture's width and height", "options": {"coordinates": "unit"},
            "evidence": f"{observed}; give image_size=WIDTHxHEIGHT too",
        },
        {"layout": "one unit for x and y, unchanged", "options": {"coordinates": "pixels"}, "evidence": observed},
    ]  # fmt: skip
    return AmbiguousInput(
        code="ambiguous_coordinates", field="tracks", expected="coordinates whose unit is certain", got=observed,
        hint="Give the option image_size=WIDTHxHEIGHT if they are fractions of the picture, else coordinates=pixels.", choices=choices,
    )  # fmt: skip

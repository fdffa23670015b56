"""Interpretation of named arrays as tracks: array, axes, units, visibility and direction of y, each with a note."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import missing_array
from pliant.worker.formats.point_names import ARRAY as NAMES
from pliant.worker.formats.point_names import note, stated, unpack
from pliant.worker.formats.reading.containers import shapes_in
from pliant.worker.formats.records import Arrays
from pliant.worker.formats.tracks.dense import flatten
from pliant.worker.formats.tracks.layouts import Reading, choose
from pliant.worker.formats.tracks.pixels import Placed, place, project, sampled
from pliant.worker.formats.tracks.third_rows import without_ones
from pliant.worker.formats.tracks.tracker_formats import (
    INTRINSICS,
    OWN,
    PLAIN,
    TRUE_SHAPES,
    Dialect,
    recognise,
    short_names,
)
from pliant.worker.formats.tracks.visibility import find_visibility

CENTRED = 0.05
"""Coordinates count as centred on zero when at least this share of them is negative, in x and in y."""


@dataclass(frozen=True, slots=True, eq=False)
class Understood:
    """A track array, interpreted but not yet validated."""

    points: NDArray[np.generic]
    """Shape `(F, P, 2)`."""

    visible: NDArray[np.float64] | None
    """Shape `(F, P)`; None: all finite points are visible."""

    format: str
    layout: str
    coordinates: str
    y_axis: str
    grid: tuple[int, int] | None
    """Rows and columns, if the points are all pixels of a picture."""

    notes: list[str]
    arrays: Arrays
    """All arrays of the file, which may include ground truth."""

    name: str
    """Name of the array that holds the tracks."""

    point_names: tuple[str, ...] | None = None
    """Names of the P points, where the file has them."""


def understand(arrays: Arrays, options: Options, *, file: Path | None = None) -> Understood:
    """Interpret the arrays of a tracks file; an error also lists the arrays of `file` that were not read.

    Raises
    ------
    InvalidInput
        Codes missing_array, missing_image_size, wrong_type, wrong_shape.
    AmbiguousInput
        Several interpretations fit.
    """
    named = short_names(arrays)
    dialect, name = _recognised(named, file)
    if dialect.name == OWN:
        return _of_our_tracker(named, name, options)
    flat = flatten(name, _numeric(named[name], name))
    spatial = dialect.third is not None or any(one in named for one in INTRINSICS)
    array, ones = (flat.array, []) if spatial else without_ones(name, flat.array)
    array, depths, named = _two_numbers(array, name, dialect, named)
    visibility = partial(find_visibility, named, grid=flat.grid, kind=options.visibility)
    reading, notes = choose(name, array, dialect=dialect, options=options, visibility=partial(_fitting, visibility))
    visible, how = visibility(reading)
    if options.visibility != "auto" and visible is None:
        how.append("Not used: the option visibility, because the file has no visibility.")
    if options.rows != "auto" and reading.rows is None:
        how.append("Not used: the option rows, because the tracks are no matrix.")
    if depths is None:
        picture = None if flat.grid is None else (flat.grid[1], flat.grid[0])
        placed = place(reading.points, visible, options, picture=picture)
    else:
        placed = _projected(depths, reading, named)
    known = depths is not None and options.y_axis == "auto"
    y_axis, why = ("down", []) if known else upwards(sampled(placed.points, visible), options)
    layout = reading.layout if flat.grid is None else f"{reading.layout}, P = {flat.grid[0]} × {flat.grid[1]} pixels"
    whose = [] if dialect.name in PLAIN else [f"Recognised by the names in the file: {dialect.name}."]
    if dialect.note and options.coordinate_order == "auto":
        whose.append(dialect.note)
    names = _names(named, placed.points.shape[1], ordered=reading.order == "frames_points")
    if names is not None:
        whose.append(note(names))
    return Understood(
        points=placed.points, visible=visible, format=dialect.name, layout=layout, coordinates=placed.coordinates,
        y_axis=y_axis, grid=flat.grid, notes=[*whose, *ones, *notes, *placed.notes, *how, *why], arrays=named, name=name,
        point_names=names,
    )  # fmt: skip


def _of_our_tracker(named: Arrays, name: str, options: Options) -> Understood:
    """Interpret tracks whose axes, unit and y direction are known; visibility and mesh are read by `film_tracks`."""
    points = _numeric(named[name], name)
    if points.ndim != 3 or points.shape[2] != 2:
        raise InvalidInput(
            "wrong_shape", field=f"tracks.{name}", expected="(frames, points, 2), as pliant track writes it", got=str(points.shape),
            hint="Save the file of pliant track as it is, or leave frame_indices out.",
        )  # fmt: skip
    y_axis = "down" if options.y_axis == "auto" else options.y_axis
    names = _names(named, points.shape[1], ordered=True)
    return Understood(
        points=points, visible=None, format=OWN, layout="tracks (F, P, 2)", coordinates="pixels", y_axis=y_axis, grid=None,
        notes=["Recognised as the output of pliant track.", *([] if names is None else [note(names)])], arrays=named, name=name,
        point_names=names,
    )  # fmt: skip


def _names(named: Arrays, count: int, *, ordered: bool) -> tuple[str, ...] | None:
    """Return the names of `count` points from an npz or, if its second axis is the points (`ordered`), from a tracker's export."""
    given = named.get(NAMES)
    if given is not None and given.dtype.kind in "US":
        return stated(given, count)
    return unpack(given, count) if ordered else None


def upwards(sample: NDArray[np.float64], options: Options) -> tuple[str, list[str]]:
    """Return the direction of y: from the options, else down unless the coordinates `(N, 2)` are centred on zero, unlike pixels."""
    if options.y_axis != "auto":
        return options.y_axis, [f"y points {options.y_axis}, as set by y_axis."]
    shares = (sample < 0).mean(axis=0) if len(sample) else np.zeros(2)
    if (shares >= CENTRED).all():
        return "up", [
            f"y is assumed to point up: {shares[1]:.0%} of its values are negative, so these are not pixels of a picture."
        ]
    return "down", ["y is assumed to point down, as in pictures: coordinates are not centred on zero."]


def _fitting(
    visibility: Callable[[Reading], tuple[NDArray[np.float64] | None, list[str]]], reading: Reading
) -> NDArray[np.float64] | None:
    """Return the visibility of an interpretation; None if the file's does not fit it."""
    try:
        return visibility(reading)[0]
    except InvalidInput:
        return None


def _two_numbers(
    array: NDArray[np.generic], name: str, dialect: Dialect, named: Arrays
) -> tuple[NDArray[np.generic], NDArray[np.generic] | None, Arrays]:
    """Split off a third number of each point: visibility is added to the arrays; points in space are returned unchanged."""
    if array.ndim != 3 or array.shape[-1] != 3 or 2 in array.shape[:2]:
        return array, None, named
    if dialect.third == "depth" or any(one in named for one in INTRINSICS):
        return array[..., :2], array, named
    third = array[..., 2].astype(np.float64)
    inside = (third >= 0) & (third <= 1)
    if dialect.third == "visibility" and bool(inside[np.isfinite(third)].all()):
        return array[..., :2], None, {"visibility": third, **named}
    raise InvalidInput(
        "unsupported_feature", field="tracks", expected="two image coordinates for each point, or a third number from 0 to 1 as visibility",
        got=f"{name} of shape {array.shape}",
        hint="Save x and y as tracks (F, P, 2); for points in space before a camera, add intrinsics=[fx, fy, cx, cy].",
    )  # fmt: skip


def _projected(depths: NDArray[np.generic], reading: Reading, named: Arrays) -> Placed:
    """Project points in space; they also serve as ground truth, unless the file has its own."""
    spatial = depths.transpose(1, 0, 2) if reading.order == "points_frames" else depths
    intrinsics = next((named[one] for one in INTRINSICS if one in named), None)
    points, kind, notes = project(spatial, intrinsics)
    if not any(one in named for one in TRUE_SHAPES):
        named["shapes"] = spatial
    return Placed(points, kind, notes)


def _recognised(named: Arrays, file: Path | None) -> tuple[Dialect, str]:
    found = recognise(named)
    if found is None:
        raise missing_array(
            "tracks", expected="an array named tracks (F, P, 2), or W (2F, P)", there=shapes_in(file, named),
            hint="Save as numpy.savez('tracks.npz', tracks=points, visibility=visible).",
        )  # fmt: skip
    return found


def _numeric(array: NDArray[np.generic], name: str) -> NDArray[np.generic]:
    if array.dtype.kind not in "fiu":
        raise wrong_numbers(f"tracks.{name}", array)
    return array


def wrong_numbers(field: str, array: NDArray[np.generic]) -> InvalidInput:
    """Return the error for an array that does not hold real numbers."""
    return InvalidInput(
        "wrong_type",
        field=field,
        expected="real numbers",
        got=f"dtype {array.dtype}",
        hint="Convert the array to float.",
    )

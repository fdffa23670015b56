"""From named arrays to tracks: which array, which axis, what its visibility means, which way is up; each said in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.client.options import Options
from pliant.solver import InvalidInput
from pliant.worker.formats.dialects import Dialect, recognise, short_names
from pliant.worker.formats.errors import refusal
from pliant.worker.formats.layouts import choose, drop_batch
from pliant.worker.formats.records import Arrays
from pliant.worker.formats.visibility import find_visibility

CENTRED = 0.05
"""Coordinates count as centred on zero when at least this share of them is negative, in x and in y."""


@dataclass(frozen=True, slots=True, eq=False)
class Understood:
    """A track array, interpreted but not yet checked."""

    points: NDArray[np.generic]
    """Shape `(F, P, 2)`."""

    visible: NDArray[np.float64] | None
    """Shape `(F, P)`, or None: all that is finite."""

    layout: str
    y_axis: str
    notes: list[str]
    arrays: Arrays
    """All that the file held, for truth that came along."""


def understand(arrays: Arrays, options: Options) -> Understood:
    """Interpret the arrays of a tracks file.

    Raises
    ------
    InvalidInput
        Codes missing_array, wrong_type, wrong_shape and those of `Tracks.from_arrays`.
    AmbiguousInput
        Two layouts fit.
    """
    named = short_names(arrays)
    dialect, name = _recognised(named)
    array = _numeric(named[name], name)
    if dialect.last == 3:
        raise refusal(
            "unsupported_feature", "tracks", expected="two image coordinates for each point",
            got=f"{name} of shape {array.shape} ({dialect.name})",
            hint="Save x and y in pixels as tracks (F, P, 2), and visibility (F, P) beside them.",
        )  # fmt: skip
    array = drop_batch(array, 3 if array.ndim == 4 else array.ndim, field="tracks")
    reading, notes = choose(name, array, dialect=dialect, options=options, field="tracks")
    found = find_visibility(named, reading.points.shape[:2], transposed=reading.order == "points_frames")
    visible, how = (None, []) if found is None else found
    notes = [*notes, *how]
    if dialect.name not in ("canonical", "matrix", "unnamed"):
        notes.insert(0, f"Recognised as the output of {dialect.name} by the names in the file.")
    y_axis, why = upwards(reading.points, options)
    return Understood(reading.points, visible, reading.layout, y_axis, [*notes, *why], named)


def upwards(points: NDArray[np.generic], options: Options) -> tuple[str, list[str]]:
    """Which way y grows: as told, else down unless the coordinates are centred on zero, as no picture's are."""
    if options.y_axis != "auto":
        return options.y_axis, []
    flat = points.reshape(-1, 2)[:: max(1, points.shape[0] * points.shape[1] // 100_000)]
    finite = flat[np.isfinite(flat).all(axis=1)]
    shares = (finite < 0).mean(axis=0) if len(finite) else np.zeros(2)
    if (shares >= CENTRED).all():
        return "up", [
            f"y is taken to point up: {shares[1]:.0%} of its values are negative, so these are not pixels of a picture."
        ]
    return "down", ["y is taken to point down, as in pictures: coordinates are not centred on zero."]


def _recognised(named: Arrays) -> tuple[Dialect, str]:
    found = recognise(named)
    if found is None:
        raise refusal(
            "missing_array", "tracks", expected="an array named tracks (F, P, 2), or W (2F, P)",
            got=", ".join(sorted(named)[:20]) or "no array of a known name",
            hint="Save as numpy.savez('tracks.npz', tracks=points, visibility=visible).",
        )  # fmt: skip
    return found


def _numeric(array: NDArray[np.generic], name: str) -> NDArray[np.generic]:
    if array.dtype.kind not in "fiu":
        raise wrong_numbers(f"tracks.{name}", array)
    return array


def wrong_numbers(field: str, array: NDArray[np.generic]) -> InvalidInput:
    """Not an array of real numbers."""
    return refusal(
        "wrong_type", field, expected="real numbers", got=f"dtype {array.dtype}", hint="Convert the array to float."
    )

"""Visibility as written by trackers: bool, probability, logits, occlusion, or two numbers to combine."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import AmbiguousInput
from pliant.worker.formats.records import Arrays
from pliant.worker.formats.tracks.dense import flatten_like
from pliant.worker.formats.tracks.layouts import Reading
from pliant.worker.formats.tracks.tracker_formats import CERTAINTY, HIDING, VISIBILITY

SURE = 0.5
"""Probability below which a point counts as hidden, since trackers extrapolate there; above, it is kept as the weight."""

TWO_MAPS = ("visconfs_e", "visconf_maps_e")
"""AllTracker's names: the first channel is visibility, the second confidence."""


def find_visibility(
    named: Arrays, reading: Reading, *, grid: tuple[int, int] | None, kind: str
) -> tuple[NDArray[np.float64] | None, list[str]]:
    """Return the confidence `(F, P)` in [0, 1] that each point is visible, None if the file has no visibility; and notes.

    `reading`, the interpretation of the tracks, is applied to visibility as well; `grid` is the size of the picture whose pixels
    the points are; `kind` is the option `visibility`.

    Raises
    ------
    InvalidInput
        Codes out_of_range, wrong_shape, wrong_type.
    AmbiguousInput
        Code out_of_range: numbers above 1 that may be a mask or logits.
    """
    name = next((name for name in VISIBILITY if name in named and name != "expected_dist"), None)
    found: list[tuple[NDArray[np.float64], str, str]] = []
    if name is not None:
        found.append((*_visibility(name, named, reading, grid, kind), name))
    notes: list[str] = []
    certain = next((each for each in CERTAINTY if each in named), None)
    if certain is not None:
        values = _certainty(certain, named[certain], reading, grid)
        if values is None:
            notes.append(
                f"Not used: {certain} {named[certain].shape}, which has no number from 0 to 1 for each observation."
            )
        else:
            found.append((values, "probabilities", certain))
    if not found:
        return None, notes
    confidence, how, name = found[0]
    if len(found) == 2:
        confidence, how = confidence * found[1][0], f"{how}, times {certain}"
    unsure = (confidence > 0) & (confidence < SURE)
    confidence[unsure] = 0.0
    return confidence, [
        f"Visibility from {name}: {how}" + (f"; below {SURE:g} counts as hidden." if unsure.any() else "."),
        *notes,
    ]


def _visibility(
    name: str, named: Arrays, reading: Reading, grid: tuple[int, int] | None, kind: str
) -> tuple[NDArray[np.float64], str]:
    """Return the probability `(F, P)` that each point is visible, 0 where it is not finite, and how it was read."""
    for each in (name, "expected_dist"):
        if each in named:
            _check_number(each, named[each], reading)
    confidence, how = _confidence(name, named[name], grid, kind)
    if name in HIDING:
        confidence = 1.0 - confidence
        how += ", turned from occlusion to visibility"
        if "expected_dist" in named:
            confidence = confidence * (1.0 - _confidence("expected_dist", named["expected_dist"], grid, "auto")[0])
            how += ", times the certainty of the position (expected_dist)"
    return np.array(_arranged(np.where(np.isfinite(confidence), confidence, 0.0), reading, name)), how


def _certainty(
    name: str, array: NDArray[np.generic], reading: Reading, grid: tuple[int, int] | None
) -> NDArray[np.float64] | None:
    """Return an array of probabilities as `(F, P)`, 0 where not finite; None if it does not fit the tracks or is not within [0, 1]."""
    try:
        _check_number(name, array, reading)
        values, _ = _confidence(name, array, grid, "probability")
        return np.array(_arranged(np.where(np.isfinite(values), values, 0.0), reading, name))
    except InvalidInput:
        return None


def _check_number(name: str, array: NDArray[np.generic], reading: Reading) -> None:
    """Reject an array with too many values for the tracks, before it is converted to eight times its size.

    There are at most two values per observation: visibility and confidence, or one for x and one for y.
    """
    frames, points = reading.points.shape[:2]
    if array.size > 2 * frames * points:
        raise _wrong_shape(name, array, reading)


def _wrong_shape(name: str, array: NDArray[np.generic], reading: Reading) -> InvalidInput:
    """Return the error for an array as it is in the file, where the axes of visibility are in the order of the tracks'."""
    frames, points = reading.points.shape[:2]
    turned = reading.order == "points_frames"
    like, axes = ((points, frames), "(points, frames)") if turned else ((frames, points), "(frames, points)")
    return InvalidInput(
        "wrong_shape", field=f"tracks.{name}", expected=f"{like}, one value for each observation", got=str(array.shape),
        hint=f"Visibility is {axes}, in the order of the tracks.",
    )  # fmt: skip


def _confidence(
    name: str, array: NDArray[np.generic], grid: tuple[int, int] | None, kind: str
) -> tuple[NDArray[np.float64], str]:
    if array.dtype.kind == "b":
        return np.array(flatten_like(array, grid), dtype=np.float64), "true or false"
    if array.dtype.kind not in "fiu":
        raise InvalidInput(
            "wrong_type", field=f"tracks.{name}", expected="bool or numbers", got=f"dtype {array.dtype}",
            hint="Convert the array to bool.",
        )  # fmt: skip
    values = np.array(array, dtype=np.float64)
    if name in TWO_MAPS and values.ndim >= 3 and values.shape[-1 if name == "visconfs_e" else -3] == 2:
        axis = values.ndim - (1 if name == "visconfs_e" else 3)
        one, two = (_meant(name, part, kind)[0] for part in np.moveaxis(values, axis, 0))
        return flatten_like(one * two, grid), "visibility times confidence"  # type: ignore[return-value]
    meant, how = _meant(name, values, kind)
    return flatten_like(meant, grid), how  # type: ignore[return-value]


def _meant(name: str, values: NDArray[np.float64], kind: str) -> tuple[NDArray[np.float64], str]:
    """Return numbers as probabilities, and a description of what they were."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    if kind == "auto":
        kind = _guessed(name, finite, low, high)
    if kind == "bool":
        word = "0 or not 0" if high > 1 or low < 0 else "0 or 1"
        return np.where(np.isfinite(values), (values != 0).astype(np.float64), np.nan), word
    if kind == "logits":
        with np.errstate(over="ignore"):
            return 1.0 / (1.0 + np.exp(-values)), f"logits (values from {low:.3g} to {high:.3g})"
    if low < 0 or high > 1:
        raise InvalidInput(
            "out_of_range", field=f"tracks.{name}", expected="probabilities from 0 to 1", got=f"values from {low:.3g} to {high:.3g}",
            hint="Set the option visibility to bool or logits.",
        )  # fmt: skip
    return values, "probabilities"


def _guessed(name: str, finite: NDArray[np.float64], low: float, high: float) -> str:
    if "logits" in name:
        return "logits"
    if low >= 0 and high >= 1 and (low == 0 or high == 1) and bool(np.isin(finite, (0.0, high)).all()):
        return "bool"
    if low >= 0 and high <= 1:
        return "probability"
    if low < 0:
        return "logits"
    choices: list[dict[str, Any]] = [
        {"layout": f"{name}: not 0 is yes", "options": {"visibility": "bool"}},
        {"layout": f"{name}: logits that are all positive", "options": {"visibility": "logits"}},
    ]
    raise AmbiguousInput(
        code="out_of_range", field=f"tracks.{name}", expected="bool, probabilities from 0 to 1, or logits of both signs",
        got=f"values from {low:.3g} to {high:.3g}", hint="Set the option visibility, or convert the array to bool.", choices=choices,
    )  # fmt: skip


def _arranged(flat: NDArray[np.float64], reading: Reading, name: str) -> NDArray[np.float64]:
    like, given = reading.points.shape[:2], flat
    if flat.ndim == 2 and reading.order == "points_frames":
        flat = flat.T
    if flat.shape == like:
        return flat
    if flat.shape == (2 * like[0], like[1]) and reading.rows is not None:  # one row for x and one for y, as in W
        pairs = (
            flat.reshape(like[0], 2, like[1])
            if reading.rows == "interleaved"
            else flat.reshape(2, like[0], like[1]).swapaxes(0, 1)
        )
        return np.ascontiguousarray(pairs.min(axis=1))
    raise _wrong_shape(name, given, reading)

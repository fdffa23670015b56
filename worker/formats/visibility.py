"""What trackers say about visibility: bool, probability, logits, occlusion instead of visibility, or two numbers to combine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.worker.formats.dialects import VISIBILITY
from pliant.worker.formats.errors import refusal
from pliant.worker.formats.records import Arrays

SURE = 0.5
"""A probability below this means hidden: trackers extrapolate there; above, it is kept as the weight."""

HIDING = ("occlusion", "occlusions", "occluded")


def find_visibility(
    named: Arrays, like: tuple[int, ...], *, transposed: bool = False
) -> tuple[NDArray[np.float64], list[str]] | None:
    """Confidence that each point is seen, in the order of the tracks.

    Parameters
    ----------
    named : dict
        The arrays of the tracks file.
    like : tuple of int
        `(F, P)` of the tracks.
    transposed : bool
        The file has points first, in the tracks and so here.

    Returns
    -------
    tuple or None
        Confidence in [0, 1], and the notes; None when the file says nothing.

    Raises
    ------
    InvalidInput
        Code wrong_shape or wrong_type.
    """
    name = next((name for name in VISIBILITY if name in named and name != "expected_dist"), None)
    if name is None:
        return None
    confidence, how = _probability(name, named[name])
    if name in HIDING:
        confidence = 1.0 - confidence
        how += ", turned from occlusion to visibility"
    if name in HIDING and "expected_dist" in named:
        certain, _ = _probability("expected_dist", named["expected_dist"])
        confidence = _flat(confidence) * (1.0 - _flat(certain))
        how += ", times the certainty of the position (expected_dist)"
    confidence = np.where(np.isfinite(confidence), confidence, 0.0)
    unsure = (confidence > 0) & (confidence < SURE)
    confidence[unsure] = 0.0
    confidence = _arranged(confidence, like, name, transposed)
    note = f"Visibility from {name}: {how}" + (f"; below {SURE:g} counts as hidden." if unsure.any() else ".")
    return confidence, [note]


def _probability(name: str, array: NDArray[np.generic]) -> tuple[NDArray[np.float64], str]:
    if array.dtype.kind == "b":
        return np.array(array, dtype=np.float64), "true or false"
    if array.dtype.kind not in "fiu":
        raise refusal(
            "wrong_type", f"tracks.{name}", expected="bool or numbers", got=f"dtype {array.dtype}",
            hint="Convert the array to bool.",
        )  # fmt: skip
    values = np.array(array, dtype=np.float64)
    if name == "visconfs_e" and values.shape[-1] == 2:
        return values[..., 0] * values[..., 1], "visibility times confidence"
    finite = values[np.isfinite(values)]
    if finite.size == 0 or (finite.min() >= 0 and finite.max() <= 1 and "logits" not in name):
        whole = finite.size == 0 or bool(np.isin(finite, (0.0, 1.0)).all())
        return values, "0 or 1" if whole else "probabilities"
    if finite.min() >= 0 and "logits" not in name:
        raise refusal(
            "out_of_range", f"tracks.{name}", expected="bool, probabilities from 0 to 1, or logits of both signs",
            got=f"values from {finite.min():.3g} to {finite.max():.3g}", hint="Convert the array to bool.",
        )  # fmt: skip
    with np.errstate(over="ignore"):
        return 1.0 / (1.0 + np.exp(-values)), f"logits (values from {finite.min():.3g} to {finite.max():.3g})"


def _flat(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without batch and channel axes of length 1."""
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    return array


def _arranged(
    confidence: NDArray[np.float64], like: tuple[int, ...], name: str, transposed: bool
) -> NDArray[np.float64]:
    flat = _flat(confidence)
    if transposed and flat.ndim == 2:
        flat = flat.T
    if flat.shape == like:
        return flat
    raise refusal(
        "wrong_shape", f"tracks.{name}", expected=f"{like}, one value for each observation", got=str(confidence.shape),
        hint="Visibility is (frames, points), in the order of the tracks.",
    )  # fmt: skip

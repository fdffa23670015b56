"""Ground truth and known cameras, in the shapes that data sets have them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput, KnownCamera
from pliant.worker.formats.contain import read_arrays
from pliant.worker.formats.dialects import TRUE_ROTATIONS, TRUE_SHAPES, short_names
from pliant.worker.formats.errors import refusal
from pliant.worker.formats.interpret import Understood
from pliant.worker.formats.records import Arrays, GroundTruth, Limits

TRUTH_NAMES = frozenset([*TRUE_SHAPES, *TRUE_ROTATIONS])
CAMERA_NAMES = frozenset([*TRUE_ROTATIONS, "scales"])


def read_truth(
    path: Path | None, understood: Understood, *, like: tuple[int, int], limits: Limits
) -> GroundTruth | None:
    """Truth from its own file, or from the tracks' file when true shapes came along.

    Raises
    ------
    InvalidInput
        Codes missing_array, wrong_shape, wrong_type; truth that came along and does not fit is passed over instead.
    """
    if path is None:
        try:
            return _truth_of(understood.arrays, like)
        except InvalidInput:
            return None
    arrays = short_names(read_arrays(path, field="ground_truth", limits=limits, wanted=TRUTH_NAMES))
    if "array" in arrays:
        arrays = {"shapes": arrays["array"]}
    truth = _truth_of(arrays, like)
    if truth is None:
        raise refusal(
            "missing_array", "ground_truth", expected="shapes (F, P, 3) or S (3F, P)",
            got=", ".join(sorted(arrays)[:20]) or "no array of a known name",
            hint="Save as numpy.savez('truth.npz', shapes=shapes).",
        )  # fmt: skip
    return truth


def read_rotations(path: Path, *, num_frames: int, limits: Limits) -> KnownCamera:
    """Known cameras: `rotations` `(F, 2|3, 3)` or `(2F, 3)`, and optionally `scales` `(F,)`.

    Raises
    ------
    InvalidInput
        Codes missing_array, wrong_shape, not_a_rotation.
    """
    arrays = short_names(read_arrays(path, field="rotations", limits=limits, wanted=CAMERA_NAMES))
    name = next((name for name in ("array", *TRUE_ROTATIONS) if name in arrays), None)
    if name is None:
        raise refusal(
            "missing_array", "rotations", expected="rotations (F, 3, 3)",
            got=", ".join(sorted(arrays)[:20]) or "no array of a known name",
            hint="Save as numpy.savez('rotations.npz', rotations=rotations).",
        )  # fmt: skip
    turned = per_frame(arrays[name], num_frames)
    if turned.dtype.kind not in "fiu" or turned.ndim != 3 or len(turned) != num_frames:
        raise refusal(
            "wrong_shape", "rotations", expected=f"({num_frames}, 2, 3) or ({num_frames}, 3, 3), real",
            got=f"{turned.dtype} {arrays[name].shape}", hint="Give one rotation for each frame of the tracks.",
        )  # fmt: skip
    return KnownCamera.from_arrays(turned, arrays.get("scales"))


def per_frame(array: NDArray[np.generic], num_frames: int) -> NDArray[np.generic]:
    """`(kF, N)` as `(F, k, N)`, and `(k, N, F)` as `(F, k, N)`; anything else as it is."""
    if array.ndim == 2 and num_frames > 0 and array.shape[0] in (2 * num_frames, 3 * num_frames):
        return array.reshape(num_frames, -1, array.shape[1])
    if array.ndim == 3 and array.shape[2] == num_frames and array.shape[0] in (2, 3):
        return array.transpose(2, 0, 1)
    return array


def _truth_of(arrays: Arrays, like: tuple[int, int]) -> GroundTruth | None:
    name = next((name for name in TRUE_SHAPES if name in arrays), None)
    if name is None:
        return None
    shapes = per_frame(arrays[name], like[0])
    if name != "shapes" and shapes.ndim == 3 and shapes.shape == (like[0], 3, like[1]):
        shapes = shapes.transpose(0, 2, 1)
    turned = next((arrays[one] for one in TRUE_ROTATIONS if one in arrays), None)
    return GroundTruth.from_arrays(shapes, None if turned is None else per_frame(turned, like[0]), like=like)

"""Ground truth and known cameras, in the array layouts of data sets, converted to frames first and points in the tracks' order.

True shapes come as `(F, P, 3)`, `(F, 3, P)`, `(3, P, F)` and the like, or as matrices `(3F, P)` with rows x1, y1, z1, x2 … or all x,
all y, all z. Among the layouts that fit an array's shape, the one whose affine projection fits the tracks best is chosen. For
rotations, the layout with the most nearly orthonormal rows is chosen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput, KnownCamera
from pliant.solver.limits import MAX_COORDINATE
from pliant.worker.formats.errors import missing_array
from pliant.worker.formats.reading.containers import read_arrays, shapes_in
from pliant.worker.formats.records import Arrays, Limits
from pliant.worker.formats.tracks.interpretation import Understood
from pliant.worker.formats.tracks.tracker_formats import TRUE_ROTATIONS, TRUE_SHAPES, short_names

TRUTH_NAMES = frozenset([*TRUE_SHAPES, *TRUE_ROTATIONS])
CAMERA_NAMES = frozenset([*TRUE_ROTATIONS, "scales"])
MIN_FIT_RATIO = 1.3
"""Factor by which another layout must fit the tracks better than the usual one."""

COMPARED_FRAMES = 24
"""Number of frames in which a layout is compared with the tracks."""

MAX_UNEXPLAINED = 0.5
"""Unexplained share of the tracks' extent above which truth and tracks are considered not to match."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """True shapes and cameras as read, not yet checked."""

    shapes: NDArray[np.generic]
    rotations: NDArray[np.generic] | None
    notes: list[str]


def read_truth(path: Path | None, understood: Understood, *, limits: Limits) -> Truth | None:
    """Return the truth from its own file, or from the tracks' file if it contains true shapes.

    Raises
    ------
    InvalidInput
        Code missing_array, if a separate file contains no true shapes.
    """
    if path is None:
        return _truth_of(understood.arrays, understood)
    arrays = short_names(read_arrays(path, field="ground_truth", limits=limits, wanted=TRUTH_NAMES))
    if "array" in arrays:
        arrays = {"shapes": arrays["array"]}
    truth = _truth_of(arrays, understood)
    if truth is None:
        raise missing_array(
            "ground_truth", expected="shapes (F, P, 3) or S (3F, P)", there=shapes_in(path, arrays),
            hint="Save as numpy.savez('truth.npz', shapes=shapes).",
        )  # fmt: skip
    return truth


def read_rotations(path: Path, *, num_frames: int, frames: NDArray[np.intp], limits: Limits) -> KnownCamera:
    """Read known cameras: `rotations` `(F, 2|3, 3)`, `(2F, 3)`, `(3, 3, F)` …, and optionally `scales` `(F,)`; keep those of `frames`.

    Raises
    ------
    InvalidInput
        Codes missing_array, wrong_shape, not_a_rotation.
    """
    arrays = short_names(read_arrays(path, field="rotations", limits=limits, wanted=CAMERA_NAMES))
    name = next((name for name in ("array", *TRUE_ROTATIONS) if name in arrays), None)
    if name is None:
        raise missing_array(
            "rotations", expected="rotations (F, 3, 3)", there=shapes_in(path, arrays),
            hint="Save as numpy.savez('rotations.npz', rotations=rotations).",
        )  # fmt: skip
    turned = as_rotations(arrays[name], num_frames)
    if turned.dtype.kind not in "fiu" or turned.ndim != 3 or len(turned) != num_frames:
        raise InvalidInput(
            "wrong_shape", field="rotations", expected=f"({num_frames}, 2, 3) or ({num_frames}, 3, 3), real",
            got=f"{turned.dtype} {arrays[name].shape}",
            hint=f"Give one rotation for each of the {num_frames} frames; if the tracks have another number, set the option layout.",
        )  # fmt: skip
    scales = arrays.get("scales")
    if scales is not None and scales.size == num_frames:
        scales = scales.reshape(-1)[frames]
    return KnownCamera.from_arrays(turned[frames], scales)


def as_rotations(array: NDArray[np.generic], num_frames: int) -> NDArray[np.generic]:
    """Return the rotations with frames first, in the layout with the most nearly orthonormal rows; unchanged if none fits."""
    found: list[NDArray[np.generic]] = []
    if array.ndim == 2:
        found = [rows for _, rows in _matrix_readings(array, num_frames, (2, 3), 3)]
    elif array.ndim == 3:
        for axis in (axis for axis in (0, 2, 1) if array.shape[axis] == num_frames):
            moved = np.moveaxis(array, axis, 0)  # rows stay before columns: a transposed rotation is a rotation too
            if moved.shape[1:] in ((2, 3), (3, 3)):
                found.append(moved)
            elif moved.shape[1:] == (3, 2):
                found.append(moved.swapaxes(1, 2))
    if not found or array.dtype.kind not in "fiu":
        return array
    return min(found, key=_askew)


def as_shapes(array: NDArray[np.generic], understood: Understood) -> tuple[NDArray[np.generic], list[str]]:
    """Return true shapes as `(F, P, 3)`, and notes with the evidence if several layouts fit the array."""
    frames, count = understood.points.shape[:2]
    found: list[tuple[str, NDArray[np.generic]]] = []
    if array.ndim == 2:
        found = [
            (f"(3F, P), rows {words}", rows.transpose(0, 2, 1))
            for words, rows in _matrix_readings(array, frames, (3,), count)
        ]
    elif array.ndim == 3:
        for axes in permutations(range(3)):
            moved = array.transpose(axes)
            if moved.shape == (frames, count, 3):
                found.append(("axes " + ", ".join("FP3"[axes.index(axis)] for axis in range(3)), moved))
    if not found or array.dtype.kind not in "fiu":
        return array, []
    if len(found) == 1:
        return found[0][1], _far(unexplained(found[0][1], understood.points, understood.visible))
    costs = [unexplained(shapes, understood.points, understood.visible) for _, shapes in found]
    best = int(np.argmin(costs))
    if costs[0] <= MIN_FIT_RATIO * costs[best]:
        best = 0
    next_best = min(cost for place, cost in enumerate(costs) if place != best)
    evidence = f"True shapes read as {found[best][0]}: a camera leaves {costs[best]:.1%} of the tracks unexplained; next {next_best:.1%}."
    return found[best][1], [evidence, *_far(costs[best])]


def unexplained(
    shapes: NDArray[np.generic], points: NDArray[np.generic], visible: NDArray[np.float64] | None = None
) -> float:
    """Return the share of the visible tracks' extent that no affine camera per frame explains from the shapes; median over some frames."""
    chosen = np.unique(np.linspace(0, len(points) - 1, COMPARED_FRAMES).round().astype(int))
    shares = []
    for frame in chosen:
        true, seen = np.asarray(shapes[frame], np.float64), np.asarray(points[frame], np.float64)
        usable = (np.abs(true) <= MAX_COORDINATE).all(axis=1) & (np.abs(seen) <= MAX_COORDINATE).all(axis=1)
        if visible is not None:
            usable &= visible[frame] > 0
        if usable.sum() < 6:
            continue
        true, seen = true[usable] - true[usable].mean(axis=0), seen[usable] - seen[usable].mean(axis=0)
        extent = np.linalg.norm(seen)
        if extent > 0:
            shares.append(np.linalg.norm(seen - true @ np.linalg.lstsq(true, seen, rcond=None)[0]) / extent)
    return float(np.median(shares)) if shares else 0.0


def _matrix_readings(
    array: NDArray[np.generic], num_frames: int, heights: tuple[int, ...], width: int
) -> Iterator[tuple[str, NDArray[np.generic]]]:
    """Yield every `(F, k, N)` that a matrix of kF rows and N columns, or its transpose, can represent."""
    for matrix in (array, array.T):
        for height in heights:
            if matrix.shape == (height * num_frames, width):
                yield "interleaved", matrix.reshape(num_frames, height, width)
                yield "stacked", matrix.reshape(height, num_frames, width).swapaxes(0, 1)


def _askew(rotations: NDArray[np.generic]) -> float:
    rows = np.asarray(rotations[:, :2], dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rows @ rows.transpose(0, 2, 1) - np.eye(2)).max(axis=(1, 2))
    return float(np.median(deviation)) if np.isfinite(deviation).all() else float("inf")


def _far(share: float) -> list[str]:
    if share <= MAX_UNEXPLAINED:
        return []
    return [
        f"The true shapes do not fit the tracks under any camera ({share:.0%} unexplained): check that both have the same order."
    ]


def _truth_of(arrays: Arrays, understood: Understood) -> Truth | None:
    name = next((name for name in TRUE_SHAPES if name in arrays), None)
    if name is None:
        return None
    shapes, notes = as_shapes(arrays[name], understood)
    turned = next((arrays[one] for one in TRUE_ROTATIONS if one in arrays), None)
    rotations = None if turned is None else as_rotations(turned, len(understood.points))
    return Truth(shapes, rotations, notes)

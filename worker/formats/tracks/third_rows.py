"""Third coordinates of tracks: 1 in homogeneous coordinates, which are removed, and matrices of three rows per frame, which are refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.solver.records import MIN_FRAMES, MIN_POINTS

Array = NDArray[np.generic]


def without_ones(name: str, array: Array) -> tuple[Array, list[str]]:
    """Remove the third coordinates of an array of two or three axes if all of them are 1, as in homogeneous coordinates; return notes."""
    if array.ndim == 3 and 2 not in array.shape:
        for axis in (axis for axis in (2, 1, 0) if array.shape[axis] == 3):
            if _is_one(array.take([2], axis=axis)):
                return array.take([0, 1], axis=axis), [_note(name, "the third number of each point")]
    if array.ndim == 2:
        for matrix, turned, word in ((array, False, "row"), (array.T, True, "column")):
            third, odd = divmod(len(matrix), 3)
            if odd or third < MIN_FRAMES or matrix.shape[1] < MIN_POINTS:
                continue
            if _is_one(matrix[2::3]):
                rest, which = np.delete(matrix, slice(2, None, 3), axis=0), f"every third {word}"
            elif _is_one(matrix[2 * third :]):
                rest, which = matrix[: 2 * third], f"the last third of the {word}s"
            else:
                continue
            return rest.T if turned else rest, [_note(name, which)]
    return array, []


def as_triples(matrix: Array) -> Array:
    """Return x and y `(F, P, 2)` of `(3F, P)` with rows x1, y1, z1, x2 …."""
    return matrix.reshape(len(matrix) // 3, 3, matrix.shape[1]).transpose(0, 2, 1)[..., :2]


def has_three_blocks(matrix: Array) -> bool:
    """Return whether x, y and z of `(3F, P)` are blocks: rows jump where y and z begin, by more than anywhere else."""
    rows = len(matrix)
    steps = np.abs(np.diff(np.asarray(matrix, dtype=np.float64), axis=0))
    known = np.isfinite(steps)
    means = np.where(known, steps, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    begins = [rows // 3 - 1, 2 * rows // 3 - 1]
    return bool(means[begins].min() > np.delete(means, begins).max(initial=0.0))


def three_rows(name: str, array: Array, rows: str) -> InvalidInput:
    """Return the error for a matrix with three rows per frame, in blocks (`stacked`) or not (`interleaved`)."""
    return InvalidInput(
        "wrong_shape", field="tracks", expected="two rows per frame, x and y",
        got=f"{name} of shape {array.shape}, which fits three {rows} rows per frame",
        hint="Save only the rows of x and y. If it has two rows per frame, set rows=interleaved or rows=stacked.",
    )  # fmt: skip


def _is_one(values: Array) -> bool:
    ones = values == 1
    return bool(ones.any() and (ones | np.isnan(values)).all())


def _note(name: str, which: str) -> str:
    return f"In {name}, {which} is 1, as in homogeneous coordinates, and is not used."

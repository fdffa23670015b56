"""Batch axes and tracks of all pixels: arrays of four and five axes reduced to three, with the original pixel grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput

MIN_RISING_SHARE = 0.95
"""Share of neighbouring pixels whose coordinates must rise for two axes to count as rows and columns."""


@dataclass(frozen=True, slots=True, eq=False)
class Flat:
    """A track array without batch and picture axes."""

    array: NDArray[np.generic]
    """Two axes (a matrix), or three of which one is the coordinates."""

    grid: tuple[int, int] | None = None
    """Rows and columns, if the points were the pixels of a picture; point index = row · columns + column."""


def flatten(name: str, array: NDArray[np.generic]) -> Flat:
    """Remove an axis of length 1, and flatten the pixels of pictures.

    Pictures are `(F, H, W, 2 or 3)` or `(F, 2, H, W)`, with or without a batch axis. Four axes with a first axis longer than 1 are
    pictures if the first frame's x increases along the columns and y along the rows, and the points of OpenCV if they are `(F, P, 1, 2)`;
    otherwise they are a batch.

    Raises
    ------
    InvalidInput
        Code wrong_shape: a batch of several videos, or more axes than are known.
    """
    if array.ndim == 5:
        return _pictures(_single(array))
    if array.ndim == 4:
        if array.shape[0] == 1 and (array.shape[-1] in (2, 3) or array.shape[1] != 2):
            return Flat(array[0])
        if _is_picture(array):
            return _pictures(array)
        if array.shape[2:] == (1, 2):
            return Flat(array[:, :, 0])
        return Flat(_single(array))
    if array.ndim > 5:
        raise InvalidInput(
            "wrong_shape", field="tracks", expected="(frames, points, 2)", got=f"{name} of shape {array.shape}",
            hint="Reshape the array to three axes.",
        )  # fmt: skip
    return Flat(array)


def flatten_like(array: NDArray[np.generic], grid: tuple[int, int] | None) -> NDArray[np.generic]:
    """Flatten the pixels of an array that accompanies tracks, and remove outer axes of length 1."""
    if grid is not None and array.ndim >= 3:
        if array.shape[-2:] == grid:
            array = array.reshape(*array.shape[:-2], grid[0] * grid[1])
        elif array.ndim >= 4 and array.shape[-3:-1] == grid:
            array = array.reshape(*array.shape[:-3], grid[0] * grid[1], array.shape[-1])
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    return array


def _single(array: NDArray[np.generic]) -> NDArray[np.generic]:
    if array.shape[0] != 1:
        raise InvalidInput(
            "wrong_shape", field="tracks", expected="one video", got=f"a batch of {array.shape[0]}",
            hint="Submit each element of the batch as its own job.",
        )  # fmt: skip
    return array.reshape(array.shape[1:])


def _pictures(array: NDArray[np.generic]) -> Flat:
    """Reshape `(F, H, W, c)` or `(F, 2, H, W)` to `(F, H·W, c)`."""
    if array.shape[-1] not in (2, 3) and array.shape[1] == 2:
        array = np.moveaxis(array, 1, 3)
    frames, rows, columns, numbers = array.shape
    return Flat(array.reshape(frames, rows * columns, numbers), (rows, columns))


def _is_picture(array: NDArray[np.generic]) -> bool:
    if array.shape[0] == 0:
        return False
    first = array[0]
    if array.shape[-1] not in (2, 3):
        if array.shape[1] != 2:
            return False
        first = np.moveaxis(first, 0, 2)
    if first.shape[0] < 2 or first.shape[1] < 2:
        return False
    with np.errstate(invalid="ignore"):
        along_columns = np.diff(first[..., 0].astype(np.float64), axis=1)
        along_rows = np.diff(first[..., 1].astype(np.float64), axis=0)
        return bool((along_columns > 0).mean() >= MIN_RISING_SHARE and (along_rows > 0).mean() >= MIN_RISING_SHARE)

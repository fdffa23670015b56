"""Selection of frames, and interpolation between them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.solver.records import Floats


def informative_frames(visible: Floats) -> NDArray[np.bool_]:
    """Return a mask of the frames with at least 3 points and a tenth of the median number, shape `(F,)`; all if fewer than 3 qualify."""
    seen = (visible > 0).sum(axis=1)
    informative = np.asarray(seen >= max(3.0, 0.1 * float(np.median(seen[seen > 0]))))
    return informative if informative.sum() >= 3 else np.ones(len(seen), dtype=bool)


def longest_gaps(visible: NDArray[np.floating[Any]]) -> NDArray[np.intp]:
    """Return the length of the longest run of frames in which each point of `visible (F, P)` is hidden, shape `(P,)`."""
    longest, gap = np.zeros(visible.shape[1], dtype=np.intp), np.zeros(visible.shape[1], dtype=np.intp)
    for shown in visible > 0:
        gap = np.where(shown, 0, gap + 1)
        np.maximum(longest, gap, out=longest)
    return longest


def evenly_spread(total: int, count: int) -> NDArray[np.intp]:
    """Return at most `count` indices below `total`, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, total - 1, min(total, count)).round().astype(np.intp))


def every_nth(count: int, most: int) -> NDArray[np.intp]:
    """Return the indices 0, n, 2n, … below `count`, with the smallest n that leaves at most `most` of them."""
    return np.arange(0, count, -(-count // most))


def of_frames(gram: Floats, used: NDArray[np.intp]) -> Floats:
    """Return the rows and columns of a Gram matrix that belong to the frames `used`, shape `(2F', 2F')`."""
    rows = np.stack([2 * used, 2 * used + 1], axis=1).ravel()
    return gram[np.ix_(rows, rows)]


def between(used: NDArray[np.intp], values: Floats, frames: int) -> Floats:
    """Return values of all frames, linearly interpolated between those of the frames `used`.

    Shapes `(F', n)` to `(F, n)`, or `(F',)` to `(F,)`.
    """
    every = np.arange(frames)
    if values.ndim == 1:
        return np.interp(every, used, values)
    found = np.zeros((frames, values.shape[1]))
    for column, each in zip(found.T, values.T, strict=True):
        column[:] = np.interp(every, used, each)
    return found

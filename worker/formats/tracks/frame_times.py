"""Times of the frames of a film, which are uneven in films of variable frame rate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.worker.formats.errors import damaged
from pliant.worker.formats.records import Arrays

ARRAY = "frame_times"

MAX_SECONDS = 1e7
"""Longest time from the first to the last frame; four months."""


def read_frame_times(arrays: Arrays, frames: int, *, field: str) -> NDArray[np.float64] | None:
    """Return the seconds of every frame, shape `(F,)`, from the arrays of `pliant track`; None without them.

    Raises
    ------
    InvalidInput
        Code damaged_file: not F finite, increasing times, or more than `MAX_SECONDS` between the first and the last.
    """
    given = arrays.get(ARRAY)
    if given is None:
        return None
    if given.shape != (frames,):
        raise damaged(field, f"{ARRAY} of shape {given.shape} beside tracks of {frames} frames")
    times = given.astype(np.float64)
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise damaged(field, f"{ARRAY} that do not increase")
    if frames > 1 and times[-1] - times[0] > MAX_SECONDS:
        raise damaged(field, f"{ARRAY} over {times[-1] - times[0]:.3g} seconds")
    return times


def mean_rate(times: NDArray[np.float64]) -> float:
    """Return the mean number of frames per second."""
    return (len(times) - 1) / float(times[-1] - times[0])


def uneven(times: NDArray[np.float64]) -> bool:
    """Return whether, at the mean rate, some frame would be shown more than half a frame too early or too late."""
    places = (times - times[0]) * mean_rate(times)
    return bool(np.abs(places - np.arange(len(times))).max() > 0.5)

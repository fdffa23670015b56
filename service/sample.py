"""A few of the tracks, small enough to send along, so that a person sees at once whether they were read rightly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.worker.formats import Inputs

FRAMES, POINTS = 16, 200
"""The most that is sent."""
BOX = 1000
"""Side of the square that holds the sample."""
HIDDEN = -1


def sample_of(inputs: Inputs) -> list[list[int]]:
    """Return some frames of some points, evenly chosen, as whole numbers in a square.

    Parameters
    ----------
    inputs : Inputs
        Checked and interpreted.

    Returns
    -------
    list of list of int
        A list a frame: x and y of each point in turn, 0 … `BOX`, x right, y down, to one scale; `HIDDEN` twice for a hidden point.
    """
    points, visible = inputs.tracks.points, inputs.tracks.visible
    frames, chosen = evenly(len(points), FRAMES), evenly(points.shape[1], POINTS)
    some = points[np.ix_(frames, chosen)] * (1.0, -1.0 if inputs.interpretation.y_axis == "up" else 1.0)
    seen = visible[np.ix_(frames, chosen)] > 0
    if not seen.any():
        return [[HIDDEN] * (2 * len(chosen))] * len(frames)
    # A gross outlier may not make everything else a dot: the square holds what lies between the outer percentiles.
    low, high = np.percentile(some[seen], (1, 99), axis=0)
    scale = 0.9 * BOX / max(float((high - low).max()), np.finfo(float).tiny)
    placed = BOX / 2 + scale * (some - (low + high) / 2)
    inside = seen & ((placed >= 0) & (placed <= BOX)).all(axis=2)
    return [[int(value) for value in frame.ravel()] for frame in np.where(inside[..., None], placed.round(), HIDDEN)]


def evenly(count: int, most: int) -> NDArray[np.intp]:
    """Return at most that many indices, evenly spread over 0 … count − 1, both ends among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.intp))

"""Optical flow between two frames, with the consistency tests of Sundaram, Brox and Keutzer (2010)."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
Grey = NDArray[np.uint8]

CYCLE_RATIO, CYCLE_FLOOR = 0.01, 0.5
"""A match is lost if |w + ŵ|² ≥ ratio · (|w|² + |ŵ|²) + floor, floor in square pixels (Sundaram et al., equation 5)."""

EDGE_RATIO, EDGE_FLOOR = 0.01, 0.002
"""A motion boundary is where |∇u|² + |∇v|² > ratio · |w|² + floor (Sundaram et al., equation 6)."""

_SERIAL = threading.Lock()
_serial_users = 0
_threads_before = 0


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Positions of one frame's points in another, with measures of their consistency."""

    points: Floats
    """Shape `(P, 2)`, pixels of the second frame."""

    gap: Floats
    """Squared distance between a point and where the flow forward and back leads, square pixels, shape `(P,)`."""

    lost: Bools
    """Points whose cycle does not close, or that left the image, shape `(P,)`."""

    boundary: Bools
    """Points on a motion boundary of the backward flow, shape `(P,)`."""


@contextmanager
def opencv_serial() -> Iterator[None]:
    """Keep OpenCV from starting threads of its own inside the block.

    DIS splits the image into as many stripes as OpenCV has threads and lets flow spread only inside a stripe, so its
    result would depend on the machine. The setting belongs to the whole process; the previous one is restored when the
    last block ends.
    """
    global _serial_users, _threads_before
    with _SERIAL:
        if _serial_users == 0:
            _threads_before = cv2.getNumThreads()
            cv2.setNumThreads(1)
        _serial_users += 1
    try:
        yield
    finally:
        with _SERIAL:
            _serial_users -= 1
            if _serial_users == 0:
                cv2.setNumThreads(_threads_before)


def dense_flow(first: Grey, second: Grey) -> Floats:
    """Compute the flow from one frame to another by dense inverse search (Kroeger et al. 2016), shape `(H, W, 2)`, pixels."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.asarray(search.calc(first, second, None), dtype=np.float32)  # type: ignore[call-overload]


def match(forward: Floats, backward: Floats, points: Floats) -> Match:
    """Carry points `(P, 2)` along the forward flow `(H, W, 2)`, and check them with the backward flow."""
    step = sample(forward, points)
    landed = points + step
    back = sample(backward, landed)
    gap = ((step + back) ** 2).sum(axis=1)
    lengths = (step**2).sum(axis=1) + (back**2).sum(axis=1)
    height, width = forward.shape[:2]
    outside = (landed < 0).any(axis=1) | (landed > (width - 1, height - 1)).any(axis=1)
    return Match(
        landed, gap, (gap >= CYCLE_RATIO * lengths + CYCLE_FLOOR) | outside, _on_boundary(backward, landed, back)
    )


def sample(field: Floats, points: Floats) -> Floats:
    """Interpolate a field `(H, W, C)` bilinearly at points `(P, 2)`; outside, the border value is repeated."""
    height, width = field.shape[:2]
    x = np.clip(points[:, 0], 0, width - 1)
    y = np.clip(points[:, 1], 0, height - 1)
    column = np.minimum(x.astype(np.int32), width - 2)
    row = np.minimum(y.astype(np.int32), height - 2)
    right = (x - column)[:, None]
    down = (y - row)[:, None]
    flat = field.reshape(height * width, -1)
    corner = row * width + column
    above = flat[corner] * (1 - right) + flat[corner + 1] * right
    below = flat[corner + width] * (1 - right) + flat[corner + width + 1] * right
    return np.asarray(above * (1 - down) + below * down, dtype=np.float32)


def _on_boundary(field: Floats, points: Floats, here: Floats) -> Bools:
    """Test the gradient of a flow at points, by central differences over two pixels."""
    steps = np.array([[1, 0], [0, 1]], dtype=np.float32)
    gradient = sum(
        (((sample(field, points + step) - sample(field, points - step)) / 2) ** 2).sum(axis=1) for step in steps
    )
    return np.asarray(gradient > EDGE_RATIO * (here**2).sum(axis=1) + EDGE_FLOOR)

"""Optical flow between two frames, with the consistency tests of Sundaram, Brox and Keutzer (2010)."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
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

STRIDE, DESCENTS, SMOOTHINGS = 4, 8, 3
"""For a flow that continues a similar one: pixels between patches, steps of their search, and steps of the smoothing after it, at every
scale. OpenCV's 3, 25 and 5 take 1.9 times as long and, on rendered films and a real face, keep at most .015 more of the observations."""

MOST_PLACES = 30_000
"""Rows or columns of positions that OpenCV reads at once; it stores the sizes of such maps in 16 bits."""

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


def dense_flow(first: Grey, second: Grey, similar: Floats | None = None) -> Floats:
    """Compute the flow from one frame to another by dense inverse search (Kroeger et al. 2016), shape `(H, W, 2)`, pixels.

    The search also tries the vectors of a `similar` flow of the same shape, if there is one, and is then shorter.
    """
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    if similar is None:
        return np.asarray(search.calc(first, second, None), dtype=np.float32)  # type: ignore[call-overload]
    search.setPatchStride(STRIDE)
    search.setGradientDescentIterations(DESCENTS)
    search.setVariationalRefinementIterations(SMOOTHINGS)
    return np.asarray(search.calc(first, second, similar.copy()), dtype=np.float32)


def match(forward: Floats, backward: Floats, points: Floats) -> Match:
    """Carry points `(P, 2)` along the forward flow `(H, W, 2)`, and check them with the backward flow."""
    step = sample(forward, points[:, None])[:, 0]
    landed = points + step
    back = sample(backward, landed[:, None])[:, 0]
    gap = ((step + back) ** 2).sum(axis=1)
    lengths = (step**2).sum(axis=1) + (back**2).sum(axis=1)
    lost = (gap >= CYCLE_RATIO * lengths + CYCLE_FLOOR) | ~in_picture(landed, forward.shape)
    return Match(landed, gap, lost, _on_boundary(backward, landed, back))


def best_of(matches: Sequence[Match], visible: Bools, sums: Floats) -> tuple[Floats, Bools, Floats]:
    """Select one match of each point: a visible one, if there is any, with the smallest sum.

    `visible` and `sums` have one row per match, shape `(M, P)`. Returns the points `(P, 2)`, and their visibility and sums `(P,)`.
    """
    best = np.lexsort((sums, ~visible), axis=0)[0]
    every = np.arange(len(best))
    return np.stack([m.points for m in matches])[best, every], visible[best, every], sums[best, every]


def in_picture(points: Floats, shape: tuple[int, ...]) -> Bools:
    """Return which points `(P, 2)` lie between the outermost pixel centres of a picture `(H, W, …)`."""
    height, width = shape[:2]
    return np.asarray(((points >= 0) & (points <= (width - 1, height - 1))).all(axis=1))


def sample(image: Floats, places: Floats) -> Floats:
    """Interpolate an image `(H, W)` or `(H, W, C)` at positions `(N, K, 2)`; outside, the border repeats.

    Returns shape `(N, K)` or `(N, K, C)`. OpenCV rounds some positions to 1/32 pixel, depending on its version and on C.
    """
    if places.shape[1] > MOST_PLACES:
        flat = sample(image, places.reshape(-1, 1, 2))
        return flat.reshape(*places.shape[:2], *image.shape[2:])
    found = np.zeros((*places.shape[:2], *image.shape[2:]), dtype=image.dtype)
    for start in range(0, len(places), MOST_PLACES):
        part = slice(start, start + MOST_PLACES)
        found[part] = cv2.remap(image, places[part], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    return found


def _on_boundary(field: Floats, points: Floats, here: Floats) -> Bools:
    """Test the gradient of a flow at points, by central differences over two pixels."""
    around = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]], dtype=np.float32)
    right, left, below, above = sample(field, points[:, None] + around).transpose(1, 0, 2)
    gradient = (((right - left) / 2) ** 2 + ((below - above) / 2) ** 2).sum(axis=1)
    return np.asarray(gradient > EDGE_RATIO * (here**2).sum(axis=1) + EDGE_FLOOR)

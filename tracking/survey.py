"""One pass over a film: store its frames for the tracker, and find times, sharpness and shot boundaries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.tracking.decoding.film import LEAST_FRAMES, Film
from pliant.tracking.errors import TrackingStopped
from pliant.tracking.flow import Floats, Grey
from pliant.tracking.frame_store import FrameStore
from pliant.tracking.records import OnStep, TrackingStep

ENLARGED_TO, LARGEST_ENLARGEMENT = 480, 3.0
"""Small films are enlarged to this longest side in pixels, at most by this factor: DIS matches at half the resolution it is given. On
rendered films of 160×120, enlarging three times halves the median error (.53 to .25 px)."""

THUMBNAIL, LEAST_THUMBNAIL = 96, 32
"""Longest and least side of the thumbnails in which cuts are detected, pixels. OpenCV's fast preset reads beyond smaller pictures: it
compares patches of 8 pixels at a quarter of the size."""

SAME_SHOT, CUT = 0.7, 0.4
"""Correlation of successive thumbnails after motion compensation: usually above the first value within a shot, below the second across a
cut."""

AROUND = 4
"""Frames compared before and after a cut: fast motion lowers the correlation for several frames, a cut for one."""

BROKEN_SHARE = 0.95
"""A film that decodes to less than this share of its declared frames has a broken tail; containers are off by a few frames."""


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Result of one pass; rows are the selected frames and those that lead to the region's frame."""

    indices: NDArray[np.int64]
    """Frame numbers in the whole film, shape `(N,)`."""

    times: NDArray[np.float64]
    """Seconds, shape `(N,)`."""

    sharpness: NDArray[np.float64]
    """Variance of the Laplacian over the variance of the grey levels, shape `(N,)`."""

    used: tuple[int, int]
    """First of the rows of the selected frames, and the row after the last."""

    cuts: tuple[int, ...]
    """Rows at which a new shot begins."""

    scale: Floats
    """Pixels of the stored frames per pixel of the film, across and down, shape `(2,)`; both sides are rounded to whole pixels."""

    broken_tail: bool
    """Whether the film ends before its declared number of frames."""


def survey(
    film: Film,
    store: FrameStore,
    *,
    reached: int | None,
    longest_side: int,
    on_step: OnStep,
    should_stop: Callable[[], bool],
) -> Survey:
    """Decode a film into a store of grey frames in the tracker's size: the selected ones and those from there to the frame `reached`.

    Raises
    ------
    FilmError
        Fewer than 3 selected frames, or an error of `Film.reaching` or `Film.frames`.
    TrackingStopped
        `should_stop` returned True.
    """
    scale, size = tracking_size(film.size, longest_side)
    indices, times, sharpness, likeness = [], [], [], [1.0]
    before: Grey | None = None
    whole = film if reached is None else film.reaching(reached)
    for frame in whole.frames():
        if should_stop():
            raise TrackingStopped
        grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        if size != film.size:
            grey = np.asarray(
                cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC), np.uint8
            )
        store.append(grey)
        indices.append(frame.index)
        times.append(frame.time)
        sharpness.append(float(cv2.Laplacian(grey, cv2.CV_32F).var() / (grey.var() + 1.0)))
        small = _thumbnail(grey)
        if before is not None:
            likeness.append(_likeness(before, small))
        before = small
        on_step(TrackingStep("read", len(indices), None))
    start, stop, _ = film.selection
    first, last = np.searchsorted(indices, [start, np.inf if stop is None else stop]).tolist()
    if last - first < LEAST_FRAMES:
        raise film.too_few_frames(last - first)
    return Survey(
        np.array(indices), np.array(times), np.array(sharpness), (first, last), find_cuts(np.array(likeness)),
        (np.array(size) / film.size).astype(np.float32), _ends_early(whole, indices[-1]),
    )  # fmt: skip


def tracking_scale(size: tuple[int, int], longest_side: int) -> float:
    """Choose the scale of the tracker's frames: large films are reduced, small ones enlarged."""
    longest = max(size)
    if longest > longest_side:
        return longest_side / longest
    return float(np.clip(min(ENLARGED_TO, longest_side) / longest, 1.0, LARGEST_ENLARGEMENT))


def tracking_size(size: tuple[int, int], longest_side: int) -> tuple[float, tuple[int, int]]:
    """Return the scale of the tracker's frames, and their width and height."""
    scale = tracking_scale(size, longest_side)
    return scale, (max(16, round(size[0] * scale)), max(16, round(size[1] * scale)))


def find_cuts(likeness: NDArray[np.float64]) -> tuple[int, ...]:
    """Find single frames unlike their predecessor among alike ones; `likeness (N,)` is the correlation with the predecessor, at first 1."""
    cuts = []
    for t in np.flatnonzero(likeness < CUT):
        around = np.concatenate([likeness[max(0, t - AROUND) : t], likeness[t + 1 : t + 1 + AROUND]])
        if np.median(around) > SAME_SHOT:
            cuts.append(int(t))
    return tuple(cuts)


def sharpest(sharpness: NDArray[np.float64], start: int, stop: int) -> int:
    """Return the sharpest frame of the middle third of a shot."""
    frames = middle_of(start, stop)
    return frames.start + int(np.argmax(sharpness[frames.start : frames.stop]))


def middle_of(start: int, stop: int) -> range:
    """Return the middle third of a shot, at least one frame."""
    first, last = start + (stop - start) // 3, stop - (stop - start) // 3
    return range(first, max(last, first + 1))


def _thumbnail(grey: Grey) -> Grey:
    factor = THUMBNAIL / max(grey.shape)
    size = (max(LEAST_THUMBNAIL, round(grey.shape[1] * factor)), max(LEAST_THUMBNAIL, round(grey.shape[0] * factor)))
    return np.asarray(
        cv2.GaussianBlur(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0), dtype=np.uint8
    )


def _likeness(first: Grey, second: Grey) -> float:
    """Return the correlation of two thumbnails, with or without motion compensation of the first, whichever is higher."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    flow = search.calc(second, first, None)  # type: ignore[call-overload]
    height, width = first.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    carried = cv2.remap(first, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return max(_correlation(first, second), _correlation(np.asarray(carried, dtype=np.uint8), second))


def _correlation(first: Grey, second: Grey) -> float:
    """Return the correlation, with one grey level of noise added to both variances, so that two blank pictures are alike."""
    a, b = first - first.mean(), second - second.mean()
    return float(((a * b).mean() + 1.0) / np.sqrt(((a**2).mean() + 1.0) * ((b**2).mean() + 1.0)))


def _ends_early(film: Film, last: int) -> bool:
    start, stop, step = film.selection
    reachable = film.stated_frames if stop is None else min(stop, film.stated_frames)
    return film.stated_frames > 0 and last + step < BROKEN_SHARE * reachable and start < reachable

"""Estimate the number of points and the time of tracking a film on this machine, from one of its frames."""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
from pliant.tracking.appearance import Appearance
from pliant.tracking.chaining import DELTAS, FIRST_SPACING, FIRST_STEPS, FLOW_MARGIN
from pliant.tracking.decoding.film import Film
from pliant.tracking.flow import Bools, Grey, dense_flow, opencv_serial
from pliant.tracking.region import Region, read_region
from pliant.tracking.registration import Registration
from pliant.tracking.seeding import Seeds, default_step, neighbours, place
from pliant.tracking.survey import tracking_scale

FLOWS = 2 * (1 + len(DELTAS))
"""Flows per frame: forward and backward, from the template and from each earlier frame."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated effort of tracking."""

    points: int
    """Points that would be tracked, before short-lived ones are dropped."""

    seconds: float
    """Wall time of flow, registration and comparison, without decoding and without fitting the points' paths. 0 without points or if the
    film gives no number of frames."""


def estimate(
    film: Film, *, region: Region | None, region_frame: int, grid_step: float | None, longest_side: int, threads: int
) -> Estimate:
    """Place the points in the region's frame; time one flow of the region's size, and the other work per frame.

    Raises
    ------
    FilmError
        The film cannot be decoded, or the region does not fit it.
    """
    grey, scale = _frame(film if region is None else film.reaching(region_frame), region_frame, longest_side)
    height, width = grey.shape
    mask = np.ones((height, width), dtype=bool)
    if region is not None:
        drawn = read_region(region, film.size).astype(np.uint8) * 255
        mask = np.asarray(cv2.resize(drawn, (width, height), interpolation=cv2.INTER_AREA) >= 128)
    seeds, _ = place(grey, mask, step=default_step(mask) if grid_step is None else grid_step * scale)
    start, stop, step = film.selection
    count = len(range(film.stated_frames)[start:stop:step])
    if len(seeds.points) == 0:
        return Estimate(0, 0.0)
    with opencv_serial():
        seconds = FLOWS * _flow_seconds(grey, mask) + _rounds_seconds(grey, mask, seeds)
    return Estimate(len(seeds.points), count * seconds / max(threads, 1))


def _frame(film: Film, index: int, longest_side: int) -> tuple[Grey, float]:
    """Return the first selected frame from `index` on, or the last one, grey and in the tracker's size, with its scale."""
    image = None
    for frame in film.frames():
        image = frame.image
        if frame.index >= index:
            break
    assert image is not None, "a film without frames is refused when it is opened"
    scale = tracking_scale(film.size, longest_side)
    size = (max(16, round(film.size[0] * scale)), max(16, round(film.size[1] * scale)))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8), scale


def _flow_seconds(grey: Grey, mask: Bools) -> float:
    """Time the flow inside the region's box between the frame and the frame moved by a pixel."""
    row, column = np.nonzero(mask)
    box = np.s_[row.min() : row.max() + 1, column.min() : column.max() + 1]
    first = np.ascontiguousarray(np.pad(grey[box], FLOW_MARGIN, mode="edge"))
    second = np.ascontiguousarray(np.roll(first, 1, axis=1))
    similar = dense_flow(first, second)
    began = time.perf_counter()
    dense_flow(first, second, similar)
    return time.perf_counter() - began


def _rounds_seconds(grey: Grey, mask: Bools, seeds: Seeds) -> float:
    """Time the work of both rounds per frame besides flow: register and compare the frame with itself, half a pixel off."""
    appearance = Appearance.of(grey, mask, seeds.points, neighbours(seeds.grid, len(seeds.points)))
    fine = Registration.of(grey, seeds.points, seeds.grid, noise=appearance.noise)
    rough = fine.coarse(grey, FIRST_SPACING)
    beside, visible = seeds.points + np.float32(0.5), np.ones(len(seeds.points), dtype=bool)
    visible[0] = False  # lost points are looked for only if there is one
    began = time.perf_counter()
    rough.refine(grey, beside, np.ones_like(beside[:, 0]), visible, steps=FIRST_STEPS)
    rough.spread(grey, beside, visible, steps=FIRST_STEPS)
    fine.refine(grey, beside, np.ones_like(beside[:, 0]), visible)
    for _ in range(2):
        appearance.agrees(grey, beside, visible)
        appearance.found(grey, beside, visible)
    return time.perf_counter() - began

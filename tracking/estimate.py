"""Estimate the number of points and the time of tracking a film on this machine, from one of its frames."""

from __future__ import annotations

import time
from dataclasses import dataclass

import cv2
import numpy as np
from pliant.tracking.appearance import Appearance
from pliant.tracking.chaining import DELTAS, FIRST_SPACING, FIRST_STEPS, box_around
from pliant.tracking.decoding.film import Film
from pliant.tracking.flow import Bools, Grey, dense_flow, opencv_serial
from pliant.tracking.region import LONG_STEP, Region, read_region, resized
from pliant.tracking.registration import Registration
from pliant.tracking.seeding import Seeds, default_step, neighbours, place
from pliant.tracking.survey import middle_of, tracking_size

FLOWS = 2 * (1 + len(DELTAS))
"""Flows per frame: forward and backward, from the template and from each earlier frame."""

LOCATING_FLOWS = 4
"""Flows of the whole picture for every `LONG_STEP` frames that the region is carried: forward and backward, directly and from the frame
before."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated effort of tracking."""

    points: int
    """Points that would be tracked, before short-lived ones are dropped."""

    seconds: float
    """Wall time of carrying the region to the template, flow, registration and comparison, without decoding and without fitting the
    points' paths. 0 without points or if the film gives no number of frames."""


def estimate(
    film: Film,
    *,
    region: Region | None,
    region_frame: int,
    template_frame: int | None = None,
    grid_step: float | None,
    longest_side: int,
    threads: int,
) -> Estimate:
    """Place the points in the region's frame; time one flow around the region and one of the picture, and the other work per frame.

    Raises
    ------
    FilmError
        The film cannot be decoded, or the region does not fit it.
    """
    grey, scale = _frame(film if region is None else film.reaching(region_frame), region_frame, longest_side)
    mask = np.ones(grey.shape, dtype=bool) if region is None else resized(read_region(region, film.size), grey.shape)
    seeds, _ = place(grey, mask, step=default_step(mask) if grid_step is None else grid_step * scale)
    start, stop, step = film.selection
    count = len(range(film.stated_frames)[start:stop:step])
    if len(seeds.points) == 0:
        return Estimate(0, 0.0)
    with opencv_serial():
        seconds = count * (FLOWS * _flow_seconds(grey[_box(mask)]) + _rounds_seconds(grey, mask, seeds))
        if region is not None and count > 0:
            origin = (region_frame - start) / step
            template = _template(origin, count) if template_frame is None else (template_frame - start) / step
            seconds += abs(template - origin) / LONG_STEP * LOCATING_FLOWS * _flow_seconds(grey)
    return Estimate(len(seeds.points), seconds / max(threads, 1))


def _template(origin: float, count: int) -> float:
    """Return the template of `count` frames by default, if the region was drawn in frame `origin` of them and is not lost."""
    middle = middle_of(0, count)
    return origin if middle.start <= origin < middle.stop else count / 2


def _frame(film: Film, index: int, longest_side: int) -> tuple[Grey, float]:
    """Return the first selected frame from `index` on, or the last one, grey and in the tracker's size, with its scale."""
    image = None
    for frame in film.frames():
        image = frame.image
        if frame.index >= index:
            break
    assert image is not None, "a film without frames is refused when it is opened"
    scale, size = tracking_size(film.size, longest_side)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8), scale


def _box(mask: Bools) -> tuple[slice, slice]:
    """Return the part of a frame in which flow is computed while the region does not move."""
    row, column = np.nonzero(mask)
    return box_around(np.array([(column.min(), row.min()), (column.max(), row.max())], dtype=np.float32), mask.shape)


def _flow_seconds(picture: Grey) -> float:
    """Time the flow between a picture and the picture moved by a pixel."""
    first = np.ascontiguousarray(picture)
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

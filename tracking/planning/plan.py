"""Choose the shot and the template of a film, and carry the region to the template."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.tracking.decoding.film import LEAST_FRAMES, Film
from pliant.tracking.errors import FilmError
from pliant.tracking.flow import Bools
from pliant.tracking.frame_store import FrameStore
from pliant.tracking.planning.options import no_such_frame
from pliant.tracking.records import OnStep
from pliant.tracking.region import resized, transport
from pliant.tracking.seeding import default_step, place
from pliant.tracking.survey import Survey, middle_of, sharpest

LEAST_LEFT, LEAST_LEFT_BY_DEFAULT = 0.1, 0.5
"""Share of the region's area that must be found in the template: in a given one, and in one that is chosen. Not tuned."""


@dataclass(frozen=True, slots=True)
class Run:
    """Resources shared by all stages."""

    film: Film
    store: FrameStore
    pool: ThreadPoolExecutor
    on_step: OnStep
    should_stop: Callable[[], bool]
    on_warnings: Callable[[list[str]], None]


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Rows `start` to `stop` of the survey, the template's row, and the mask of the template in the tracker's size."""

    start: int
    stop: int
    template: int
    mask: Bools

    lost_in_middle: bool = False
    """Whether the template is not in the middle of the shot only because the region is mostly lost there."""


def plan_of(run: Run, found: Survey, mask: Bools | None, *, region_frame: int, template_frame: int | None) -> Plan:
    """Choose shot and template, and carry the region, a mask `(H, W)` of the film's size in `region_frame`, to the template.

    By default, the template is the region's frame if that lies in the middle third of the shot, otherwise the sharpest frame of that third:
    the farther a frame is from the template, the less its picture resembles it. With the region drawn on the first frame, an opening hand
    was tracked with a median error of .53 px from that frame and .35 px from the middle, and its shapes had errors of .51 and .08. If the
    region is mostly lost on the way, the template is a frame on that way, see `_farthest`.

    Raises
    ------
    FilmError
        A frame beyond the film's end, a template outside the region's shot, a shot of fewer than 3 frames, or a lost region.
    TrackingStopped
        `run.should_stop` returned True.
    """
    first, last = found.used
    origin = None if mask is None else _nearest(found.indices, region_frame, "region_frame")
    template = None
    if template_frame is not None:
        template = first + _nearest(found.indices[first:last], template_frame, "template_frame")
    start, stop = _shot(found, template if origin is None else origin)
    if template is not None and not start <= template < stop:
        raise FilmError(
            "no_such_frame", field="template_frame", got=str(template_frame),
            expected=f"a frame of the region's shot, {found.indices[start]} to {found.indices[stop - 1]}",
            hint="Choose one of these, or draw the region in the shot of the template (region_frame).",
        )  # fmt: skip
    middle = sharpest(found.sharpness, start, stop)
    shape = run.store.read(0).shape
    if mask is None or origin is None:
        return Plan(start, stop, middle if template is None else template, np.ones(shape, dtype=bool))
    scaled = resized(mask, shape)
    lost = template is None and origin not in middle_of(start, stop)
    if lost:
        on_the_way = ((row, part) for row, part in _carried(run, scaled, origin, middle) if start <= row < stop)
        chosen = _farthest(on_the_way, scaled, origin, middle)
        if chosen is not None:
            return Plan(start, stop, *chosen, chosen[0] not in middle_of(start, stop))
    template = min(max(origin, start), stop - 1) if template is None else template
    return Plan(start, stop, template, scaled if template == origin else _carry(run, scaled, origin, template), lost)


def _shot(found: Survey, row: int | None) -> tuple[int, int]:
    """Return the used rows, from start to stop, of the shot that contains a row; None: of the longest shot."""
    shots = list(itertools.pairwise([0, *found.cuts, len(found.indices)]))
    if row is None:
        start, stop = max(shots, key=lambda shot: shot[1] - shot[0])
    else:
        start, stop = next(shot for shot in shots if shot[0] <= row < shot[1])
    first, last = max(start, found.used[0]), min(stop, found.used[1])
    if first >= last:
        raise FilmError(
            "region_lost", field="region_frame", expected="a region drawn in the shot of the frames used",
            got=f"one drawn in frames {found.indices[start]} to {found.indices[stop - 1]}, before or after a cut",
            hint="Draw the region on one of the frames used, or use other frames.",
        )  # fmt: skip
    if last - first < LEAST_FRAMES:
        raise FilmError(
            "too_few_frames", field="film", expected=f"a shot of at least {LEAST_FRAMES} frames", got=f"{last - first} between two cuts",
            hint="Film the object in one take, or draw the region in a longer shot (region_frame).",
        )  # fmt: skip
    return first, last


def _carry(run: Run, mask: Bools, origin: int, template: int) -> Bools:
    """Carry the region to a given template."""
    carried = np.zeros_like(mask)
    for _, part in _carried(run, mask, origin, template):
        carried = part  # at last that in the template
    if carried.sum() < LEAST_LEFT * mask.sum():
        raise FilmError(
            "region_lost", field="region", expected="a region that can be followed to the template",
            got=f"{carried.sum() / max(mask.sum(), 1):.0%} of it left there",
            hint="Draw the region in the template frame itself (region_frame), or choose a template nearer to it. Draw a larger region if "
            "this one is a few pixels wide.",
        )  # fmt: skip
    return carried


def _farthest(parts: Iterable[tuple[int, Bools]], mask: Bools, origin: int, middle: int) -> tuple[int, Bools] | None:
    """Return a row and the part of the region found there: the middle if this is half of it or more, otherwise a row on the way.

    A template with the share q of the region, d rows from the drawn one, follows it in these rows and, as an estimate, in as many beyond.
    Of the rows with at least half of the region, the one with the largest q d is returned; None if there is none. One part at a time is in
    memory besides the best, so that the way may be long.
    """
    best, most = None, 0.0
    for row, part in parts:
        share = min(float(part.sum() / mask.sum()), 1.0)
        if share < LEAST_LEFT_BY_DEFAULT:
            continue
        if row == middle:
            return row, part
        if share * abs(row - origin) > most:
            best, most = (row, part), share * abs(row - origin)
    return best


def _carried(run: Run, mask: Bools, origin: int, end: int) -> Iterator[tuple[int, Bools]]:
    """Yield rows on the way to another one, each with the part of the region that is found there.

    Points without texture are used, too, because only the outline counts. Nothing is found if no point of the grid lies in the region.
    """
    seeds, _ = place(run.store.read(origin), mask, step=default_step(mask), everywhere=True)
    if len(seeds.points) == 0:
        return iter(())
    return transport(
        run.store.read, mask, seeds, origin, end, pool=run.pool, on_step=run.on_step, should_stop=run.should_stop
    )


def _nearest(indices: NDArray[np.int64], frame: int, field: str) -> int:
    """Return the row of the frame nearest to a frame number, which may be that of a skipped frame after the last one."""
    last = int(2 * indices[-1] - indices[-2]) - 1
    if frame > last:
        raise no_such_frame(field, frame, 0, last)
    return int(np.abs(indices - frame).argmin())

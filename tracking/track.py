"""From a film to dense tracks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.solver.threads import available_cores
from pliant.tracking.advice import warnings_before, warnings_of, warnings_unread
from pliant.tracking.appearance import Appearance
from pliant.tracking.chaining import FIRST_SPACING, Chain, chain
from pliant.tracking.contact_sheet import View, view_of
from pliant.tracking.decoding.film import Film, open_film
from pliant.tracking.decoding.limits import FilmLimits
from pliant.tracking.errors import FilmError, TrackingStopped
from pliant.tracking.flow import Bools, Floats, Grey, opencv_serial
from pliant.tracking.frame_store import FrameStore
from pliant.tracking.records import FilmInfo, Followed, OnStep, TrackedFilm, TrackingStep
from pliant.tracking.region import Region, read_region, transport
from pliant.tracking.registration import Registration
from pliant.tracking.seeding import default_step, keep, neighbours, place, quads
from pliant.tracking.survey import Survey, sharpest, survey, tracking_scale
from pliant.tracking.trajectories import track_again

LONGEST_SIDE = 960
"""Default longest side of the tracker's frames, pixels: full HD is halved, which loses little after video compression."""

LEAST_SEEN = 0.2
"""Share of the frames in which a point must be visible to be kept."""

LEAST_POINTS = 16
"""Minimum number of points for a surface: a 4 × 4 grid."""

THUMBNAILS = 6
THUMBNAIL_WIDTH = 320
"""Pixels; small films are enlarged, so that drawn tracks do not cover the picture."""


@dataclass(frozen=True, slots=True)
class _Run:
    """Resources shared by all stages."""

    film: Film
    store: FrameStore
    pool: ThreadPoolExecutor
    on_step: OnStep
    should_stop: Callable[[], bool]
    on_warnings: Callable[[list[str]], None]


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """Rows `start` to `stop` of the survey, the template's row, and the mask of the template in the tracker's size."""

    start: int
    stop: int
    template: int
    mask: Bools


def track_film(
    film: Path | str | Film,
    *,
    region: Region | None = None,
    region_frame: int = 0,
    template_frame: int | None = None,
    grid_step: float | None = None,
    longest_side: int = LONGEST_SIDE,
    frames: int | slice | str | None = None,
    limits: FilmLimits | None = None,
    threads: int | None = None,
    on_step: OnStep | None = None,
    on_warnings: Callable[[list[str]], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> TrackedFilm:
    """Track a grid of points on a surface in a film.

    Flow is DIS (Kroeger et al. 2016), chained as in MFT (Neoral et al. 2024), checked by cycle consistency (Sundaram et al. 2010)
    and by correlation with the template. The result does not depend on the number of threads.

    Parameters
    ----------
    film
        A path, see `open_film`, or an opened film.
    region
        Region to track, in `region_frame`: the path of a mask picture, a mask `(H, W)`, or a polygon `(N, 2)`, all in the film's
        pixels. By default, the whole picture.
    region_frame, template_frame
        Frame numbers, counted in the whole film from 0; the nearest selected frame is used. The template is the frame whose
        points are followed to both ends: by default the region's frame, or a sharp one in the middle if no region is given.
    grid_step
        Distance of neighbouring points in the film's pixels; by default 4 to 8 pixels of the tracker's frames, chosen for about
        4,000 points in the region.
    longest_side
        Longest side of the frames that are tracked, pixels; larger films are reduced. The tracks are in the film's own pixels.
    frames, limits
        See `open_film`; ignored for a film that is already open.
    threads
        Threads for optical flow; by default one per available core, at most 4.
    on_step
        Called after every frame of every stage.
    on_warnings
        Called with the warnings so far, which are the first of the result's: before the film is read, and again before its points are
        followed.
    should_stop
        Called at every frame of every stage; returning True stops the tracker.

    Raises
    ------
    FilmError
        The film, the region or an option cannot be used; the message suggests what to do, or what to film instead.
    TrackingStopped
        `should_stop` returned True.
    """
    _check_options(grid_step, longest_side, threads)
    opened = film if isinstance(film, Film) else open_film(film, frames=frames, limits=limits)
    stop = should_stop or (lambda: False)
    workers = threads or min(4, available_cores())
    with opencv_serial(), FrameStore() as store, ThreadPoolExecutor(workers) as pool:
        run = _Run(opened, store, pool, on_step or (lambda _: None), stop, on_warnings or (lambda _: None))
        mask = None if region is None else read_region(region, opened.size)
        run.on_warnings(warnings_unread(whole=region is None))
        found = survey(opened, store, longest_side=longest_side, on_step=run.on_step, should_stop=stop)
        step = None if grid_step is None else grid_step * tracking_scale(opened.size, longest_side)
        plan = _plan(run, found, mask, region_frame, template_frame)
        return _track(run, found, plan, step, whole=region is None)


def _plan(run: _Run, found: Survey, mask: Bools | None, region_frame: int, template_frame: int | None) -> _Plan:
    """Choose shot and template, and carry the region there."""
    height, width = run.store.read(0).shape
    origin = _nearest(found, region_frame, "region_frame")
    edges = [0, *found.cuts, len(found.indices)]
    shots = list(itertools.pairwise(edges))
    if mask is not None:
        start, stop = next(shot for shot in shots if shot[0] <= origin < shot[1])
    elif template_frame is not None:
        start, stop = next(
            shot for shot in shots if shot[0] <= _nearest(found, template_frame, "template_frame") < shot[1]
        )
    else:
        start, stop = max(shots, key=lambda shot: shot[1] - shot[0])
    if stop - start < 3:
        raise FilmError(
            "too_few_frames", field="film", expected="a shot of at least 3 frames", got=f"{stop - start} between two cuts",
            hint="Film the object in one take, or draw the region in a longer shot (region_frame).",
        )  # fmt: skip
    if template_frame is not None:
        template = min(max(_nearest(found, template_frame, "template_frame"), start), stop - 1)
    else:
        template = origin if mask is not None else sharpest(found.sharpness, start, stop)
    if mask is None:
        return _Plan(start, stop, template, np.ones((height, width), dtype=bool))
    scaled = cv2.resize(mask.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_AREA) >= 128
    if template != origin:
        scaled = _carry(run, np.asarray(scaled), origin, template)
    return _Plan(start, stop, template, np.asarray(scaled))


def _carry(run: _Run, mask: Bools, origin: int, template: int) -> Bools:
    """Carry the region to the template, with points without texture too, because only the outline counts."""
    step = default_step(mask)
    seeds, _ = place(run.store.read(origin), mask, step=step, everywhere=True)
    if len(seeds.points) == 0:
        raise FilmError(
            "region_lost", field="region", expected="a region that can be followed to the template",
            got=f"one narrower than {2 * step:.0f} pixels of the tracker's frames",
            hint="Draw a larger region, or draw it in the template frame itself (region_frame).",
        )  # fmt: skip
    carried = transport(
        run.store.read, mask, seeds, origin, template, pool=run.pool, on_step=run.on_step, should_stop=run.should_stop
    )
    if carried.sum() < 0.1 * mask.sum():
        raise FilmError(
            "region_lost", field="region", expected="a region that can be followed to the template",
            got=f"{carried.sum() / max(mask.sum(), 1):.0%} of it left there",
            hint="Draw the region in the template frame itself (region_frame), or choose a template nearer to it.",
        )  # fmt: skip
    return carried


def _track(run: _Run, found: Survey, plan: _Plan, step: float | None, *, whole: bool) -> TrackedFilm:
    """Seed, chain, track again, drop points visible in few frames, and assemble the result."""
    template = run.store.read(plan.template)
    seeds, textured = place(template, plan.mask, step=step or default_step(plan.mask))
    if len(seeds.points) < LEAST_POINTS:
        raise FilmError(
            "no_texture", field="region", expected=f"texture for at least {LEAST_POINTS} points in the template",
            got=f"{len(seeds.points)} (texture in {textured:.0%} of the region)",
            hint="Draw a larger region, use a smaller grid_step, or film a surface with a pattern, in focus and in good light.",
        )  # fmt: skip
    notes = warnings_before(run.film, found, plan.start, plan.stop, whole=whole, rough=textured)
    run.on_warnings(notes)
    appearance = Appearance.of(template, plan.mask, seeds.points, neighbours(seeds.grid, len(seeds.points)))
    fine = Registration.of(template, seeds.points, seeds.grid, noise=appearance.noise)
    rough = fine.coarse(template, FIRST_SPACING)
    length = plan.stop - plan.start
    done = 1

    def on_frame(t: int, points: Floats, visible: Bools) -> None:
        nonlocal done
        done += 1
        row = plan.start + t
        followed = Followed(int(found.indices[row]), float(found.times[row]), _in_film(points, found.scale), visible)
        run.on_step(TrackingStep("track", done, 2 * length - 1, followed))

    def read(t: int) -> Grey:
        return run.store.read(plan.start + t)

    chained = chain(
        read, length, plan.template - plan.start, appearance, rough,
        pool=run.pool, on_frame=on_frame, should_stop=run.should_stop,
    )  # fmt: skip
    track_again(
        read, chained, plan.template - plan.start, appearance, rough, fine,
        pool=run.pool, on_frame=on_frame, should_stop=run.should_stop,
    )  # fmt: skip
    kept_grid, kept = keep(seeds.grid, chained.visible.mean(axis=0) >= LEAST_SEEN)
    if len(kept) < LEAST_POINTS:
        raise FilmError(
            "tracks_lost", field="film", expected=f"at least {LEAST_POINTS} points that stay visible in {LEAST_SEEN:.0%} of the frames",
            got=str(len(kept)),
            hint="Film more slowly and with more light, so that successive frames overlap and are not blurred.",
        )  # fmt: skip
    return _assemble(run, found, plan, chained, kept_grid, kept, notes)


def _assemble(
    run: _Run,
    found: Survey,
    plan: _Plan,
    chained: Chain,
    grid: NDArray[np.int32],
    kept: NDArray[np.int64],
    notes: list[str],
) -> TrackedFilm:
    """Convert the tracks to the film's pixels, in the chain's memory, and add pictures and warnings."""
    rows = slice(plan.start, plan.stop)
    width, height = run.film.size
    indices, times = found.indices[rows], found.times[rows]
    visible, confidence = chained.visible[:, kept], chained.confidence[:, kept]
    for points in chained.points:
        points[: len(kept)] = _in_film(points[kept], found.scale)
    tracks = chained.points[:, : len(kept)]
    template = plan.template - plan.start
    picked = np.unique(np.linspace(0, len(indices) - 1, THUMBNAILS).round().astype(np.int64))
    view = view_of(tracks, visible, run.film.size)
    image, thumbnails = _pictures(run, indices, template, picked, view)
    span = float(times[-1] - times[0])
    info = FilmInfo(
        run.film.path.name, run.film.container, run.film.size, (len(times) - 1) / span if span > 0 else run.film.fps,
        indices, times, tuple(int(found.indices[row]) for row in found.cuts),
    )  # fmt: skip
    uv = ((tracks[template] + 0.5) / np.array([width, height])).astype(np.float32)
    warnings = (*notes, *warnings_of(tracks, visible, template))
    return TrackedFilm(
        info, tracks, visible, confidence, grid, quads(grid), template, image, uv, thumbnails, view, picked, warnings
    )


def _in_film(points: Floats, scale: Floats) -> Floats:
    """Convert positions from the tracker's frames, which are `scale` times as wide and high, to the film's pixels."""
    return (points + np.float32(0.5)) / scale - np.float32(0.5)


def _pictures(
    run: _Run, indices: NDArray[np.int64], template: int, picked: NDArray[np.int64], view: View
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Decode the film again for the template in colour and the thumbnails; the store holds grey frames only."""
    wanted = {int(indices[row]) for row in picked} | {int(indices[template])}
    left, top, width, height = view
    small = (THUMBNAIL_WIDTH, max(1, round(run.film.size[1] * THUMBNAIL_WIDTH / run.film.size[0])))
    thumbnails, image = {}, np.zeros((0, 0, 3), np.uint8)
    for frame in run.film.frames():
        if run.should_stop():
            raise TrackingStopped
        if frame.index in wanted:
            part = frame.image[top : top + height, left : left + width]
            thumbnails[frame.index] = np.asarray(cv2.resize(part, small, interpolation=cv2.INTER_AREA), np.uint8)
        if frame.index == indices[template]:
            image = frame.image
        if frame.index >= max(wanted):
            break
    return image, np.stack([thumbnails[int(indices[row])] for row in picked])


def _nearest(found: Survey, frame: int, field: str) -> int:
    """Return the row of the used frame nearest to a frame number, which may be that of a skipped frame after the last one used."""
    last = int(2 * found.indices[-1] - found.indices[-2]) - 1
    if not 0 <= frame <= last:
        raise FilmError(
            "no_such_frame", field=field, expected=f"a frame number from 0 to {last}", got=str(frame),
            hint="Frames are counted in the whole film from 0.",
        )  # fmt: skip
    return int(np.abs(found.indices - frame).argmin())


def _check_options(grid_step: float | None, longest_side: int, threads: int | None) -> None:
    checks = (
        ("grid_step", "a distance of 1 to 100 pixels", grid_step, grid_step is None or 1 <= grid_step <= 100),
        ("longest_side", "64 to 4096 pixels", longest_side, 64 <= longest_side <= 4096),
        ("threads", "1 to 64 threads", threads, threads is None or 1 <= threads <= 64),
    )
    for field, expected, got, good in checks:
        if not good:
            raise FilmError("out_of_range", field=field, expected=expected, got=str(got), hint="Correct the argument.")

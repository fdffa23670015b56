"""From a film to dense tracks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pliant.schemas.film_limits import FilmLimits
from pliant.solver.threads import available_cores, serial_blas
from pliant.tracking.advice import warnings_before, warnings_of, warnings_unread
from pliant.tracking.appearance import Appearance
from pliant.tracking.chaining import FIRST_SPACING, Chain, OnFrame, chain
from pliant.tracking.contact_sheet import View, view_of
from pliant.tracking.decoding.film import RATES, Film, open_film
from pliant.tracking.errors import FILM_SLOWLY, FilmError, TrackingStopped
from pliant.tracking.flow import Bools, Floats, Grey, opencv_serial
from pliant.tracking.frame_store import FrameStore
from pliant.tracking.planning.options import check_against, check_numbers
from pliant.tracking.planning.plan import Plan, Run, plan_of
from pliant.tracking.records import FilmInfo, Followed, OnStep, Stage, TrackedFilm, TrackingStep
from pliant.tracking.region import Region, read_region
from pliant.tracking.registration import Registration
from pliant.tracking.seeding import Seeds, default_step, keep, neighbours, place, quads
from pliant.tracking.survey import Survey, survey, tracking_scale
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

THUMBNAIL_HEIGHTS = (80, 960)
"""Least and greatest height of a thumbnail, pixels. Films more than four times as wide as high, or three times as high as wide, are not
shown to scale: their tracks would be invisible, or the contact sheet higher than a JPEG can be (65,535 pixels)."""


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
    region_frame
        Frame of the region, counted in the whole film from 0. If it lies before or after the selected frames, those between are read
        as well, to follow the region to them.
    template_frame
        Frame whose points are followed to both ends, counted likewise: the selected frame nearest to this number; by default the
        region's frame if it lies in the middle third of the shot, otherwise the sharpest frame of that third, to which the region is
        followed, or a frame on the way there if most of the region is lost.
    grid_step
        Distance of neighbouring points in the film's pixels, at least one pixel of the tracker's frames; by default 4 to 8 of these,
        chosen for about 4,000 points in the region.
    longest_side
        Longest side of the frames that are tracked, pixels; larger films are reduced. The tracks are in the film's own pixels.
    frames
        Frames to use, see `open_film`; ignored for a film that is already open.
    limits
        Limits on the film, see `open_film`; ignored for a film that is already open.
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
    check_numbers(
        grid_step=grid_step, longest_side=longest_side, threads=threads, region_frame=region_frame, template_frame=template_frame
    )  # fmt: skip
    opened = film if isinstance(film, Film) else open_film(film, frames=frames, limits=limits)
    check_against(
        opened, region=region, region_frame=region_frame, template_frame=template_frame, grid_step=grid_step,
        longest_side=longest_side,
    )  # fmt: skip
    stop = should_stop or (lambda: False)
    workers = threads or min(4, available_cores())
    with opencv_serial(), serial_blas(), FrameStore() as store, ThreadPoolExecutor(workers) as pool:
        run = Run(opened, store, pool, on_step or (lambda _: None), stop, on_warnings or (lambda _: None))
        mask = None if region is None else read_region(region, opened.size)
        run.on_warnings(warnings_unread(whole=region is None, region_frame=region_frame))
        reached = None if region is None else region_frame
        found = survey(opened, store, reached=reached, longest_side=longest_side, on_step=run.on_step, should_stop=stop)
        step = None if grid_step is None else grid_step * tracking_scale(opened.size, longest_side)
        plan = plan_of(run, found, mask, region_frame=region_frame, template_frame=template_frame)
        return _track(run, found, plan, step, whole=region is None, region_frame=region_frame)


def _track(run: Run, found: Survey, plan: Plan, step: float | None, *, whole: bool, region_frame: int) -> TrackedFilm:
    """Seed, chain, track again, drop points visible in few frames, and assemble the result."""

    def warnings(rough: float) -> list[str]:
        return warnings_before(
            run.film, found, plan.start, plan.stop, whole=whole, region_frame=region_frame, rough=rough,
            lost_in_middle=plan.template if plan.lost_in_middle else None,
        )  # fmt: skip

    template = run.store.read(plan.template)
    run.on_warnings(warnings(1.0))  # a cut may be why the region has no texture
    seeds, textured = _placed(template, plan, step)
    notes = warnings(textured)
    run.on_warnings(notes)
    appearance = Appearance.of(template, plan.mask, seeds.points, neighbours(seeds.grid, len(seeds.points)))
    fine = Registration.of(template, seeds.points, seeds.grid, noise=appearance.noise)
    rough = fine.coarse(template, FIRST_SPACING)
    length = plan.stop - plan.start

    def reporter(stage: Stage) -> OnFrame:
        done = itertools.count(2)  # the template is known

        def on_frame(t: int, points: Floats, visible: Bools) -> None:
            row = plan.start + t
            shown = Followed(int(found.indices[row]), float(found.times[row]), _in_film(points, found.scale), visible)
            run.on_step(TrackingStep(stage, next(done), length, shown))

        return on_frame

    def read(t: int) -> Grey:
        return run.store.read(plan.start + t)

    chained = chain(
        read, length, plan.template - plan.start, appearance, rough,
        pool=run.pool, on_frame=reporter("track"), should_stop=run.should_stop,
    )  # fmt: skip
    track_again(
        read, chained, plan.template - plan.start, appearance, rough, fine,
        pool=run.pool, on_frame=reporter("refine"), should_stop=run.should_stop,
        on_part=lambda done, total: run.on_step(TrackingStep("fit", done, total)),
    )  # fmt: skip
    seen = chained.times_seen()  # once is in the template alone, where no point moves
    kept_grid, kept = keep(seeds.grid, (seen / length >= LEAST_SEEN) & (seen >= 2))
    if len(kept) < LEAST_POINTS:
        raise FilmError(
            "tracks_lost", field="film",
            expected=f"at least {LEAST_POINTS} points that stay visible in {LEAST_SEEN:.0%} of the frames, and in two or more",
            got=str(len(kept)),
            hint=FILM_SLOWLY,
        )  # fmt: skip
    return _assemble(run, found, plan, chained, kept_grid, kept, notes)


def _placed(template: Grey, plan: Plan, step: float | None) -> tuple[Seeds, float]:
    """Place the points in the template; return them and the share of the region with texture."""
    seeds, textured = place(template, plan.mask, step=step or default_step(plan.mask))
    if len(seeds.points) < LEAST_POINTS:
        share = "no point of the grid lies in" if textured is None else f"texture in {textured:.0%} of"
        raise FilmError(
            "no_texture", field="region", expected=f"texture for at least {LEAST_POINTS} points in the template",
            got=f"{len(seeds.points)} ({share} the region)",
            hint="Draw a larger region, use a smaller grid_step, or film a surface with a pattern, in focus and in good light.",
        )  # fmt: skip
    return seeds, textured or 0.0


def _assemble(
    run: Run,
    found: Survey,
    plan: Plan,
    chained: Chain,
    grid: NDArray[np.int32],
    kept: NDArray[np.int64],
    notes: list[str],
) -> TrackedFilm:
    """Convert the tracks to the film's pixels and variances to confidences, in the chain's arrays, and add pictures and warnings."""
    rows = slice(plan.start, plan.stop)
    width, height = run.film.size
    indices, times = found.indices[rows], found.times[rows]
    frames, placed = chained.visible.shape
    usual, left = chained.usual_variance(), len(kept)
    for t in range(frames):
        chained.points[t, :left] = _in_film(chained.points[t, kept], found.scale)
        chained.visible[t, :left], chained.variance[t, :left] = chained.visible[t, kept], chained.variance[t, kept]
        chained.let_go()
    chained = Chain(chained.points[:, :left], chained.visible[:, :left], chained.variance[:, :left])
    tracks, visible = chained.points, chained.visible
    template = plan.template - plan.start
    picked = np.unique(np.linspace(0, len(indices) - 1, THUMBNAILS).round().astype(np.int64))
    view = view_of(tracks, visible, run.film.size)
    image, thumbnails = _pictures(run, indices, template, picked, view)
    span = float(times[-1] - times[0])
    info = FilmInfo(
        run.film.path.name, run.film.container, run.film.size, min((len(times) - 1) / span, RATES[1]) if span > 0 else run.film.fps,
        indices, times, tuple(int(found.indices[row]) for row in found.cuts),
    )  # fmt: skip
    uv = ((tracks[template] + 0.5) / np.array([width, height])).astype(np.float32)
    warnings = (*notes, *warnings_of(tracks, visible, chained.variance, template, placed=placed, least_seen=LEAST_SEEN))
    confidence = chained.variance
    for t in range(frames):
        confidence[t] = chained.confidence(slice(t, t + 1), usual)[0]
        chained.let_go()
    return TrackedFilm(
        info, tracks, visible, confidence, grid, quads(grid), template, image, uv, thumbnails, view, picked, warnings
    )


def _in_film(points: Floats, scale: Floats) -> Floats:
    """Convert positions from the tracker's frames, which are `scale` times as wide and high, to the film's pixels."""
    return (points + np.float32(0.5)) / scale - np.float32(0.5)


def _pictures(
    run: Run, indices: NDArray[np.int64], template: int, picked: NDArray[np.int64], view: View
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Decode the film again for the template in colour and the thumbnails; the store holds grey frames only."""
    wanted = {int(indices[row]) for row in picked} | {int(indices[template])}
    left, top, width, height = view
    high = round(run.film.size[1] * THUMBNAIL_WIDTH / run.film.size[0])
    small = (THUMBNAIL_WIDTH, int(np.clip(high, *THUMBNAIL_HEIGHTS)))
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

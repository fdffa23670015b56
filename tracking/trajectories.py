"""Track once more, from the positions that the whole film predicts for every point.

One frame alone cannot distinguish a wrong match from a right one, but all frames together can: the paths of all points lie near a
low-dimensional space, in which the frames that match well determine a path (Irani, Multi-frame correspondence estimation using subspace
constraints, 2002; Garg, Roussos, Agapito, 2013). Every frame is registered again from the paths in this space, and lost points are searched
for there and, a pixel or two away, where the other points move them.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from pliant.solver import Tracks
from pliant.solver.records import MIN_POINTS
from pliant.solver.tracks.completion import RANKS, choose_points, coefficients_of, fit_basis, predict
from pliant.solver.tracks.normalization import normalize
from pliant.tracking.appearance import Appearance
from pliant.tracking.chaining import FIRST_STEPS, Chain, OnFrame, Read
from pliant.tracking.errors import FILM_SLOWLY, FilmError, TrackingStopped
from pliant.tracking.flow import Bools, Floats
from pliant.tracking.registration import Registration

WINDOW = 300
"""Maximum number of frames whose paths are fitted together, besides the template; bounds the memory. Not tuned. On a rendered face of 660
frames, one part and three have median errors of .136 px both, 95th percentiles of .71 and .70 px, and recalls of .973 and .966."""

POINTS_AT_ONCE = 512
"""Points whose paths are computed together; all at once, in double precision, take six times the tracks' memory."""

FRAMES_AHEAD = 8
"""Frames whose registration is queued or running: two for each of the default's four threads at most."""


OnPart = Callable[[int, int], None]
"""Called with the number of completed parts, and with the number of all, which may turn out to be fewer."""


def windows(frames: int, template: int) -> list[NDArray[np.intp]]:
    """Return the frames whose paths are fitted together: parts of at most `WINDOW` frames, each with the template."""
    return [np.union1d(part, [template]) for part in np.array_split(np.arange(frames), -(-frames // WINDOW))]


def move_to_expected(chained: Chain, template: int, should_stop: Callable[[], bool]) -> None:
    """Move all points, except in the template, to paths in a low-dimensional space, fitted to their positions weighted by confidence.

    Every window has its own space, fitted to a sample of the points. Its dimension is the one that best predicts held-out positions. Where
    a window shows too few points, they stay where they are.

    Raises
    ------
    FilmError
        Code tracks_lost: no window shows enough points beyond the template.
    TrackingStopped
        `should_stop`, which is called after every dimension tried and before every part of the points, returned True; some points may
        have been moved.
    """
    usual, random, most = chained.usual_variance(), np.random.default_rng(0), 0
    for rows in windows(len(chained.points), template):
        again = int(np.count_nonzero(np.count_nonzero(chained.visible[rows], axis=0) >= 2))
        most = max(most, again)
        if again >= MIN_POINTS:
            _move_in_window(chained, rows, rows != template, usual, random, should_stop)
    if most < MIN_POINTS:
        raise FilmError(
            "tracks_lost", field="film", expected=f"at least {MIN_POINTS} points that stay visible beyond the template",
            got=str(most), hint=FILM_SLOWLY,
        )  # fmt: skip


def _move_in_window(
    chained: Chain,
    rows: NDArray[np.intp],
    moving: Bools,
    usual: float | None,
    random: np.random.Generator,
    should_stop: Callable[[], bool],
) -> None:
    """Move all points in the frames `rows (W,)` where `moving (W,)`."""
    weight = chained.confidence(rows, usual)
    chosen = choose_points(weight, random)
    sample = normalize(Tracks.from_arrays(chained.points[rows[:, None], chosen], weight[:, chosen]))
    basis, spread, scale = fit_basis(sample.points, np.asarray(sample.visible), random, should_stop=should_stop)
    centre = sample.centroid[:, None]
    for start in range(0, weight.shape[1], POINTS_AT_ONCE):
        if should_stop():
            raise TrackingStopped
        part = np.arange(start, min(start + POINTS_AT_ONCE, weight.shape[1]))
        points = (chained.points[rows[:, None], part] - centre) / sample.unit
        relative = weight[:, part].astype(np.float64) / sample.full_confidence
        coefficients, _ = coefficients_of(points, relative, basis, spread, scale, sweeps=4)
        paths = predict(basis, coefficients) * sample.unit + centre
        chained.points[rows[moving][:, None], part] = paths[moving]
        chained.let_go()


def track_again(
    read: Read,
    chained: Chain,
    template: int,
    appearance: Appearance,
    rough: Registration,
    fine: Registration,
    *,
    pool: ThreadPoolExecutor,
    on_frame: OnFrame,
    should_stop: Callable[[], bool],
    on_part: OnPart | None = None,
) -> None:
    """Register every frame again from the predicted positions; points that match the template there become visible again.

    Lost points are tried twice: where their paths predict them and, because paths of points that are often lost are inaccurate, where they
    go along with the others in a rough registration. `chained` is the result of `chain`; its arrays are overwritten.
    `on_part` is called while the paths are fitted, `on_frame` as by `chain`.

    Raises
    ------
    FilmError, TrackingStopped
        See `move_to_expected`.
    """
    frames, count = chained.visible.shape
    done = itertools.count(1)
    parts = len(windows(frames, template)) * (len(RANKS) + len(range(0, count, POINTS_AT_ONCE)))

    def stopped_at_part() -> bool:
        if on_part is not None and not should_stop():
            on_part(next(done), parts)
        return should_stop()

    move_to_expected(chained, template, stopped_at_part)
    chained.points[template] = appearance.points

    def again(t: int) -> tuple[Floats, Bools, Floats]:
        frame, path = read(t), chained.points[t]
        alike = appearance.found(frame, path, chained.visible[t])
        near = rough.spread(frame, path, alike, steps=FIRST_STEPS)
        alike = appearance.found(frame, near, alike)
        points, variance = fine.refine(frame, near, chained.variance[t], alike)
        return points, appearance.agrees(frame, points, alike), variance

    ahead: deque[tuple[int, Future[tuple[Floats, Bools, Floats]]]] = deque()
    others = (t for t in range(frames) if t != template)
    try:
        ahead.extend((t, pool.submit(again, t)) for t in itertools.islice(others, FRAMES_AHEAD))
        while ahead:
            if should_stop():
                raise TrackingStopped
            t, future = ahead.popleft()
            points, visible, variance = future.result()
            ahead.extend((t, pool.submit(again, t)) for t in itertools.islice(others, 1))
            chained.points[t], chained.visible[t], chained.variance[t] = points, visible, variance
            chained.let_go()
            on_frame(t, points, visible)
    finally:
        for _, future in ahead:
            future.cancel()

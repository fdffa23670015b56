"""Tracks from flow: a long and a short way to every frame, the more certain of which wins.

After MFT (Neoral, Šerých, Matas, WACV 2024): a point of the template reaches frame t directly, or through its place in the frame
before t. Variances add along the way, and of the ways that do not lose the point the one of less variance is taken. A point that had
been lost is carried on with its surroundings and counts as seen again where it looks like the template. MFT itself has ways through 2, 4,
8, 16 and 32 frames before t as well, and lost points stay lost for them.

Flow needs pictures, not points, so that of the next frame is computed while the points of this one are registered.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from pliant.tracking.appearance import Appearance
from pliant.tracking.errors import TrackingStopped
from pliant.tracking.flow import Bools, Floats, Grey, Match, dense_flow, match
from pliant.tracking.registration import Registration

STEP_VARIANCE = 0.01
"""Variance of one flow whose cycle closes exactly, square pixels: 0.1 px, the accuracy of DIS on textured surfaces."""

FIRST_STEPS = 2
"""Gauss–Newton steps of the registration, which `track_again` repeats. With 4 the final errors on a rendered face are 4 % smaller."""

FLOW_MARGIN = 32
"""Pixels around the points within which flow is computed: twice the largest patch that DIS searches at its coarsest scale."""

Read = Callable[[int], Grey]
OnFrame = Callable[[int, Floats, Bools], None]


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Tracks of one template's points, in pixels of the tracker's frames."""

    points: Floats
    """Shape `(F, P, 2)`; where a point is hidden, the best guess."""

    visible: Bools
    """Shape `(F, P)`."""

    variance: Floats
    """Of the places, square pixels, shape `(F, P)`, see `Registration.refine`."""

    @property
    def confidence(self) -> Floats:
        """Median variance of the visible places over a place's own, at most 1; 0 where hidden, shape `(F, P)`."""
        usual = max(float(np.median(self.variance[self.visible])), float(np.finfo(np.float32).tiny))
        return np.where(self.visible, usual / np.maximum(self.variance, usual), 0).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """What is known of the points in one frame: a frame's row of `Chain`, and the variance of the flows that lead there."""

    points: Floats
    visible: Bools
    variance: Floats
    along: Floats


def chain(
    read: Read,
    num_frames: int,
    template: int,
    appearance: Appearance,
    registration: Registration,
    *,
    pool: ThreadPoolExecutor,
    on_frame: OnFrame,
    should_stop: Callable[[], bool],
) -> Chain:
    """Track the points of a template to both ends of the film.

    Parameters
    ----------
    read
        Grey frame by index, all of one size.
    num_frames, template
        F, and the index of the template.
    appearance
        The points `(P, 2)` and what the template shows around them.
    registration
        The same points, and what the template shows between them.
    pool
        Threads for the flows of one frame.
    on_frame
        Called after every tracked frame with its index, the points `(P, 2)` in pixels of the tracker's frames, and which are visible.
    should_stop
        Asked before every frame.

    Raises
    ------
    TrackingStopped
        `should_stop` returned True.
    """
    count = len(appearance.points)
    none = np.zeros(count, dtype=np.float32)
    first = _State(appearance.points, np.ones(count, dtype=bool), none, none)
    result = Chain(
        np.zeros((num_frames, count, 2), np.float32),
        np.zeros((num_frames, count), bool),
        np.zeros((num_frames, count), np.float32),
    )
    _store(result, template, first)
    for direction, end in ((1, num_frames), (-1, -1)):
        frames = range(template + direction, end, direction)
        latest = before = first  # of the last frame and the one before
        ahead = (
            None
            if len(frames) == 0
            else _Links.to(read, frames[0], direction, template, first.points, first.points, pool)
        )
        for t, following in itertools.zip_longest(frames, frames[1:]):
            if should_stop():
                raise TrackingStopped
            assert ahead is not None
            links, ahead = ahead, None
            if following is not None:
                # Until then, two more frames: nearly all points move about alike.
                drift = 2 * np.median(latest.points - before.points, axis=0)
                near = np.concatenate([latest.points, latest.points + drift])
                ahead = _Links.to(read, following, direction, template, first.points, near, pool)
            before, latest = latest, _advance(read(t), links, first, latest, appearance, registration, pool)
            _store(result, t, latest)
            on_frame(t, latest.points, latest.visible)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Link:
    """Flow there and back between two frames, within a box of both."""

    corner: Floats
    """Upper left pixel of the box, `(2,)`."""

    there: Future[Floats]
    back: Future[Floats]

    @classmethod
    def of(cls, first: Grey, second: Grey, box: tuple[slice, slice], pool: ThreadPoolExecutor) -> _Link:
        """Begin to compute both flows."""
        one, other = np.ascontiguousarray(first[box]), np.ascontiguousarray(second[box])
        corner = np.array([box[1].start, box[0].start], dtype=np.float32)
        return cls(corner, pool.submit(dense_flow, one, other), pool.submit(dense_flow, other, one))

    def carry(self, points: Floats) -> Match:
        """Carry points of the first frame, `(P, 2)`, to the second."""
        found = match(self.there.result(), self.back.result(), points - self.corner)
        return Match(found.points + self.corner, found.gap, found.lost, found.boundary)


@dataclass(frozen=True, slots=True, eq=False)
class _Links:
    """The two ways to a frame."""

    long: _Link
    """From the template."""

    short: _Link | None
    """From the frame before; None if that is the template."""

    @classmethod
    def to(
        cls, read: Read, t: int, direction: int, template: int, first: Floats, near: Floats, pool: ThreadPoolExecutor
    ) -> _Links:
        """Begin to compute the flows to frame t, around the points of the template and those expected there: the rest decides nothing."""
        frame, before = read(t), t - direction
        long = _Link.of(read(template), frame, _box(np.concatenate([first, near]), frame.shape), pool)
        if before == template:
            return cls(long, None)
        return cls(long, _Link.of(read(before), frame, _box(near, frame.shape), pool))


def _box(points: Floats, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return rows and columns of a frame around points, with a margin; multiples of 16 keep the pyramid's levels on whole pixels."""
    height, width = shape
    inside = np.clip(points, 0, (width - 1, height - 1))
    left, top = (np.maximum(inside.min(axis=0) - FLOW_MARGIN, 0) // 16 * 16).astype(int)
    right, bottom = np.ceil(np.minimum(inside.max(axis=0) + FLOW_MARGIN, (width, height)) / 16).astype(int) * 16
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def _advance(
    frame: Grey,
    links: _Links,
    first: _State,
    latest: _State,
    appearance: Appearance,
    registration: Registration,
    pool: ThreadPoolExecutor,
) -> _State:
    """Find the points in a frame from the states of the template and of the frame before."""
    long = links.long.carry(first.points)
    ways = [(first, long, long.lost)]
    if links.short is not None:
        short = links.short.carry(latest.points)
        # Slow turning and bending steepen the long flow from the template everywhere; there a gradient is no sign of an edge.
        ways.append((latest, short, short.lost | short.boundary))
    # A point that had been lost is carried on with the flow around it, and may be seen again where it looks like the template.
    visible = np.stack([~lost for _, _, lost in ways])
    along = np.stack([state.along + found.gap + STEP_VARIANCE for state, found, _ in ways])
    best = np.lexsort((along, ~visible), axis=0)[0]
    every = np.arange(len(best))
    points = np.stack([found.points for _, found, _ in ways])[best, every]
    points, variance = registration.refine(frame, points, along[best, every], visible[best, every], steps=FIRST_STEPS)
    seen = appearance.agrees(frame, points, visible[best, every], pool=pool)
    return _State(points, seen, variance, along[best, every])


def _store(result: Chain, t: int, state: _State) -> None:
    result.points[t], result.visible[t], result.variance[t] = state.points, state.visible, state.variance

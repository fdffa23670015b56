"""Tracks from flow: long- and short-range candidates, the most certain of which wins.

After MFT (Neoral, Šerých, Matas, WACV 2024): a point of the template reaches frame t directly, or through its place in a
frame shortly before t. Variances add along the way, a point that one link loses is lost for that candidate, and the
candidate of least variance among those that see the point is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from pliant.tracking.appearance import Appearance
from pliant.tracking.errors import TrackingStopped
from pliant.tracking.flow import Bools, Floats, Grey, Match, match
from pliant.tracking.registration import Registration

DELTAS = (1, 8)
"""Frames back from t of the candidates beside the template itself; MFT has 1, 2, 4, 8, 16, 32. On four rendered films and 177 frames of a
real one, {∞, 1, 4, 16} has the same median error to 2 % and takes a third more flows."""

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
        recent = {template: first}
        for t in range(template + direction, end, direction):
            if should_stop():
                raise TrackingStopped
            recent[t] = _advance(read, t, direction, recent, template, appearance, registration, pool)
            _store(result, t, recent[t])
            recent = {s: state for s, state in recent.items() if s == template or abs(t - s) < max(DELTAS)}
            on_frame(t, recent[t].points, recent[t].visible)
    return result


def _advance(
    read: Read,
    t: int,
    direction: int,
    recent: dict[int, _State],
    template: int,
    appearance: Appearance,
    registration: Registration,
    pool: ThreadPoolExecutor,
) -> _State:
    """Find the points in frame t from the states of the frames between the template and t."""
    sources = [template, *(t - direction * delta for delta in DELTAS if abs(t - template) > delta)]
    frame = read(t)
    near = recent[t - direction].points[recent[t - direction].visible]
    matches = list(
        pool.map(lambda s: _match_nearby(read(s), frame, recent[s].points, near, recent[s].visible), sources)
    )
    states = [recent[s] for s in sources]
    # Slow turning and bending steepen the long flow from the template everywhere; there a gradient is no sign of an edge.
    lost = [m.lost if s == template else m.lost | m.boundary for s, m in zip(sources, matches, strict=True)]
    visible = np.stack([state.visible & ~gone for state, gone in zip(states, lost, strict=True)])
    along = np.stack([state.along + m.gap + STEP_VARIANCE for state, m in zip(states, matches, strict=True)])
    best = np.lexsort((along, ~visible), axis=0)[0]
    every = np.arange(len(best))
    points = np.stack([m.points for m in matches])[best, every]
    points, variance = registration.refine(frame, points, along[best, every], visible[best, every], steps=FIRST_STEPS)
    seen = appearance.agrees(frame, points, visible[best, every], pool=pool)
    return _State(points, seen, variance, along[best, every])


def _match_nearby(first: Grey, second: Grey, points: Floats, near: Floats, visible: Bools) -> Match:
    """Match inside a box around the visible points of both frames: flow elsewhere costs time and decides nothing."""
    around = np.concatenate([points[visible], near])
    if len(around) == 0:
        return Match(points, np.zeros(len(points), np.float32), np.ones(len(points), bool), np.ones(len(points), bool))
    height, width = first.shape
    margin = FLOW_MARGIN + 0.1 * np.ptp(around, axis=0).max()
    # Multiples of 16 keep the pyramid's levels on whole pixels.
    left, top = (np.maximum(around.min(axis=0) - margin, 0) // 16 * 16).astype(int)
    right, bottom = np.ceil(np.minimum(around.max(axis=0) + margin, (width, height)) / 16).astype(int) * 16
    box = np.s_[top:bottom, left:right]
    corner = np.array([left, top], dtype=np.float32)
    found = match(np.ascontiguousarray(first[box]), np.ascontiguousarray(second[box]), points - corner)
    return Match(found.points + corner, found.gap, found.lost, found.boundary)


def _store(result: Chain, t: int, state: _State) -> None:
    result.points[t], result.visible[t], result.variance[t] = state.points, state.visible, state.variance

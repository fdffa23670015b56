"""Chain optical flow into tracks, choosing the most certain of long- and short-range candidates.

After MFT (Neoral, Šerých, Matas, WACV 2024): a point of the template reaches frame t directly, or via its position in a frame shortly
before t. Variances add along the way, a candidate loses a point if one of its links does, and of the candidates that see the point the one
with the least variance is taken.

Every flow also tries the vectors of the one before it, which finds long and fast motions more often and needs fewer steps. It depends on
the points only through the boxes in which flow is computed, so the next frame's flow is computed while this frame's points are registered.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.storage import allocated, let_go
from pliant.solver.tracks.frame_selection import evenly_spread
from pliant.tracking.appearance import Appearance
from pliant.tracking.errors import TrackingStopped
from pliant.tracking.flow import Bools, Floats, Grey, Match, best_of, dense_flow, match
from pliant.tracking.registration import ROUNDING, Registration

DELTAS = (1, 8)
"""Offsets in frames, before t, of the candidates besides the template; MFT uses 1, 2, 4, 8, 16, 32. On four rendered films and 177 frames
of a real one, {∞, 1, 4, 16} has the same median error to 2 % and needs a third more flows. Without 8, a talking head of 120 frames keeps
.71 of its points instead of .81."""

STEP_VARIANCE = 0.01
"""Variance of a flow whose cycle closes exactly, square pixels: (0.1 px)², the accuracy of DIS on textured surfaces."""

FIRST_STEPS = 2
"""Gauss–Newton steps of the first registration; `track_again` registers again. With 4 the final errors on a rendered face are 1 to 4 %
smaller."""

FIRST_SPACING = 2.0
"""Distance of the samples in the first registration, pixels. 1 instead of 2 takes a tenth more time, lowers the median errors of rendered
films by at most 2 % and their recall by at most .004."""

FLOW_MARGIN = 32
"""Pixels around the points within which flow is computed: twice the largest patch that DIS searches at its coarsest scale."""

JUDGED_FRAMES = 300
"""Maximum number of frames, evenly spread, from which the usual variance of a position is taken; bounds the memory."""

Box = tuple[slice, slice]
"""Rows and columns of a frame."""

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
    """Variance of the positions, square pixels, shape `(F, P)`; see `Registration.refine`."""

    @classmethod
    def stored(cls, frames: int, points: int) -> Chain:
        """Return a chain of zeros in temporary files, so that long films take no more memory than short ones."""
        folder = tempfile.gettempdir()
        return cls(
            allocated((frames, points, 2), folder, np.float32), allocated((frames, points), folder, bool),
            allocated((frames, points), folder, np.float32),
        )  # fmt: skip

    def let_go(self) -> None:
        """Release the memory of stored arrays; their files are read when they are used again."""
        let_go(self.points, self.visible, self.variance)

    def times_seen(self) -> NDArray[np.int64]:
        """Return the number of frames in which every point is visible, shape `(P,)`."""
        count = np.zeros(self.visible.shape[1], np.int64)
        for seen in self.visible:
            count += seen
            let_go(self.visible)
        return count

    def usual_variance(self) -> float | None:
        """Return the median variance of the visible positions in at most `JUDGED_FRAMES` frames; None if all are exact.

        Positions in the template, and in frames identical to it, are exact: half of their variance or more is `ROUNDING`. If most visible
        positions are exact, as in a film whose object rests for a while, the median excludes them.
        """
        parts = []
        for t in evenly_spread(len(self.points), JUDGED_FRAMES):
            parts.append(self.variance[t][self.visible[t]])
            self.let_go()
        found = np.concatenate(parts)
        inexact = found[found > 2 * ROUNDING]
        if inexact.size == 0:
            return None
        usual = float(np.median(found))
        return usual if usual > 2 * ROUNDING else float(np.median(inexact))

    def confidence(self, rows: slice | NDArray[np.intp], usual: float | None) -> Floats:
        """Return the confidence of some frames, shape `(n, P)`: the usual variance over a position's own, at most 1; 0 where hidden."""
        if usual is None:
            return self.visible[rows].astype(np.float32)
        return np.where(self.visible[rows], usual / np.maximum(self.variance[rows], usual), 0).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """State of the points in one frame: its row of `Chain`, and the summed variance `along` of the flows that lead there."""

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
    """Track the points of a template to both ends of the film; `template` is its frame index.

    `read` returns grey frames by index. `on_frame` is called after every tracked frame with its index, the points in pixels of the
    tracker's frames, and their visibility; `should_stop` is called before every frame.

    Raises
    ------
    TrackingStopped
        `should_stop` returned True.
    """
    count = len(appearance.points)
    none = np.zeros(count, dtype=np.float32)
    first = _State(appearance.points, np.ones(count, dtype=bool), none, none)
    result = Chain.stored(num_frames, count)
    _store(result, template, first)
    for direction, end in ((1, num_frames), (-1, -1)):
        frames = range(template + direction, end, direction)
        recent, near = {template: first}, first.points
        links = _links(read, frames[0], direction, template, recent, near, {}, pool) if frames else {}
        for t, following in itertools.zip_longest(frames, frames[1:]):
            if should_stop():
                raise TrackingStopped
            ahead = {} if following is None else _links(read, following, direction, template, recent, near, links, pool)
            found = _advance(read(t), links, recent, template, appearance, registration, pool)
            _store(result, t, found)
            result.let_go()
            on_frame(t, found.points, found.visible)
            near = _two_frames_on(recent[t - direction], found) if found.visible.any() else first.points
            recent[t] = found
            recent = {s: state for s, state in recent.items() if s == template or abs(t - s) < max(DELTAS)}
            links = ahead
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Link:
    """Flow there and back between two frames, within a box of both."""

    box: Box
    there: Future[Floats]
    back: Future[Floats]

    @classmethod
    def of(cls, first: Grey, second: Grey, box: Box, before: _Link | None, pool: ThreadPoolExecutor) -> _Link:
        """Start computing both flows in `pool`, which also try the vectors of a link between similar frames, if there is one."""
        one, other = np.ascontiguousarray(first[box]), np.ascontiguousarray(second[box])
        if before is None:
            return cls(box, pool.submit(dense_flow, one, other), pool.submit(dense_flow, other, one))

        def flow(first: Grey, second: Grey, similar: Future[Floats]) -> Floats:
            return dense_flow(first, second, _in_box(similar.result(), before.box, box))

        return cls(box, pool.submit(flow, one, other, before.there), pool.submit(flow, other, one, before.back))

    def carry(self, points: Floats) -> Match:
        """Carry points of the first frame, `(P, 2)`, to the second."""
        corner = np.array([self.box[1].start, self.box[0].start], dtype=np.float32)
        found = match(self.there.result(), self.back.result(), points - corner)
        return Match(found.points + corner, found.gap, found.lost, found.boundary)


def _links(
    read: Read,
    t: int,
    direction: int,
    template: int,
    recent: dict[int, _State],
    near: Floats,
    before: dict[int, _Link],
    pool: ThreadPoolExecutor,
) -> dict[int, _Link]:
    """Start computing the flows to frame t; return them by source frame.

    Flow is computed around the visible points of the source frame, if already known, and around the positions `near` t only. `before` holds
    the flows to the previous frame: the flow from the template continues the one there, and flows over 1 or 8 frames resemble those over
    as many frames before.
    """
    frame, links = read(t), {}
    for s in (template, *(t - direction * delta for delta in DELTAS if abs(t - template) > delta)):
        around = np.concatenate([recent[s].points[recent[s].visible], near]) if s in recent else near
        similar = before.get(s if s == template else s - direction)
        links[s] = _Link.of(read(s), frame, box_around(around, frame.shape), similar, pool)
    return links


def _in_box(flow: Floats, old: Box, new: Box) -> Floats:
    """Return a flow, known in an old box of the picture, in a new box; outside the old one, its border repeats."""
    rows, columns = (
        np.clip(np.arange(after.start, after.stop), before.start, before.stop - 1) - before.start
        for before, after in zip(old, new, strict=True)
    )
    return np.ascontiguousarray(flow[np.ix_(rows, columns)])


def _two_frames_on(before: _State, latest: _State) -> Floats:
    """Return the visible points and, since most points move alike, their predicted positions two frames later."""
    seen = latest.points[latest.visible]
    drift = 2 * np.median(seen - before.points[latest.visible], axis=0)
    return np.concatenate([seen, seen + drift])


def box_around(points: Floats, shape: tuple[int, ...]) -> Box:
    """Return rows and columns of a frame around points, with a margin; multiples of 16 keep the pyramid's levels on whole pixels.

    A margin of `FLOW_MARGIN` alone takes 5 % less time, but loses 7 % more of the observations of a talking head.
    """
    height, width = shape
    inside = np.clip(points, 0, (width - 1, height - 1))
    margin = FLOW_MARGIN + 0.1 * np.ptp(inside, axis=0).max()
    left, top = (np.maximum(inside.min(axis=0) - margin, 0) // 16 * 16).astype(int)
    right, bottom = np.minimum(np.ceil((inside.max(axis=0) + margin) / 16) * 16, (width, height)).astype(int)
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def _advance(
    frame: Grey,
    links: dict[int, _Link],
    recent: dict[int, _State],
    template: int,
    appearance: Appearance,
    registration: Registration,
    pool: ThreadPoolExecutor,
) -> _State:
    """Locate the points in a frame from the states of frames between the template and this frame."""
    states, matches = [recent[s] for s in links], [link.carry(recent[s].points) for s, link in links.items()]
    # Turning and bending steepen the long flow from the template everywhere, so its gradient does not indicate an edge.
    lost = [m.lost if s == template else m.lost | m.boundary for s, m in zip(links, matches, strict=True)]
    visible = np.stack([state.visible & ~gone for state, gone in zip(states, lost, strict=True)])
    along = np.stack([state.along + m.gap + STEP_VARIANCE for state, m in zip(states, matches, strict=True)])
    points, visible, along = best_of(matches, visible, along)
    points, variance = registration.refine(frame, points, along, visible, steps=FIRST_STEPS)
    seen = appearance.agrees(frame, points, visible, pool=pool)
    return _State(points, seen, variance, along)


def _store(result: Chain, t: int, state: _State) -> None:
    result.points[t], result.visible[t], result.variance[t] = state.points, state.visible, state.variance

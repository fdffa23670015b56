"""Frames in poor minima start again from the depths of similar frames.

A sheet that is nearly flat, or seen from its edge, may end in a minimum where its edges fit their lengths worse than in other frames. For
given lengths, frames are independent, so each can start again from the depths of frames with similar images and keep what fits better.
Good depths spread from frame to frame in this way, as good matches spread from pixel to pixel in Barnes et al. (2009), "PatchMatch: a
randomized correspondence algorithm for structural image editing".
"""

from __future__ import annotations

import numpy as np
from pliant.solver.isometry.inextensible import Indices, SurfaceGraph
from pliant.solver.isometry.refinement import (
    CONVERGED,
    MOST_DAMPED,
    Isometry,
    blocks_of,
    ease_of,
    losses_of,
    refine,
    residuals,
    weights_of,
)  # fmt: skip
from pliant.solver.limits import CHUNK_OBSERVATIONS
from pliant.solver.pulse import ShouldStop, never, pulse
from pliant.solver.records import Floats
from scipy import sparse

SIMILAR_FRAMES, BETTER = 4, 0.5
"""A frame may start from this many of the most similar frames, if their mean cost is below this share of its own, and keeps the depths
found if theirs is. Costs of frames in the right minimum vary less: what is hardly better is not another minimum. All six rolling sheets of
`benchmarks.accuracy.kinds` have about the same errors with a share of 1 for the second condition."""

FRAME_ITERATIONS = 30
"""Maximum number of Gauss–Newton steps of a frame, as in `refinement.refine`."""

MAX_STEP = 1.0
"""Maximum change of a log depth in a step; longer steps lead to depths that cannot be represented."""


def refine_with_restarts(graph: SurfaceGraph, depths: Floats, *, should_stop: ShouldStop = never) -> Isometry:
    """Return depths with nearly constant edge lengths, close to the given ones except in frames where other depths fit better.

    Parameters
    ----------
    graph : SurfaceGraph
        Must have at least one visible edge.
    depths : array, shape (F, A)
        Starting depths, positive where visible.
    should_stop : callable, optional
        Called between steps; once it returns True, the best depths so far are returned.
    """
    found = refine(graph, depths, should_stop=should_stop)
    restarted = _restarted(graph, found, should_stop)
    if restarted is None:
        return found
    again = refine(graph, restarted, should_stop=should_stop)
    return again if again.inconsistency < found.inconsistency else found


def _restarted(graph: SurfaceGraph, found: Isometry, should_stop: ShouldStop) -> Floats | None:
    """Return depths `(F, A)`, with better ones in some frames; None if there are none."""
    left, _ = residuals(graph, np.log(found.depths[graph.seen]), found.lengths)
    ease = ease_of(left, found.lengths)
    depths, costs = found.depths.copy(), _costs(graph, left, ease)
    similar = similar_frames(graph, SIMILAR_FRAMES)
    untried, changed = np.ones(similar.shape, dtype=bool), False
    while not should_stop():
        open_starts = untried & (costs[similar] < BETTER * costs[:, None])
        frames = np.flatnonzero(open_starts.any(axis=1))
        if len(frames) == 0:
            break
        choice = open_starts[frames].argmax(axis=1)
        untried[frames, choice] = False
        part = graph.of(frames)
        begun = carried(depths[similar[frames, choice]], part)
        after, lower = refine_frames(part, begun, found.lengths, ease)
        better = lower < BETTER * costs[frames]
        chosen = frames[better]
        depths[chosen], costs[chosen] = after[better], lower[better]
        untried |= np.isin(similar, chosen)
        changed |= len(chosen) > 0
    return depths if changed else None


def carried(depths: Floats, graph: SurfaceGraph) -> Floats:
    """Return the depths `(N, A)` of other frames as depths of N frames: their mean where the other frame shows no point, 0 where hidden."""
    shown = depths > 0
    mean = depths.sum(axis=1, keepdims=True) / np.maximum(shown.sum(axis=1, keepdims=True), 1)
    return np.where(graph.seen, np.where(shown, depths, np.where(mean > 0, mean, 1.0)), 0.0)


def refine_frames(graph: SurfaceGraph, depths: Floats, lengths: Floats, ease: float) -> tuple[Floats, Floats]:
    """Return depths `(F, A)` of lower cost for given edge lengths `(E,)`, and the mean cost per edge of every frame, `(F,)`.

    Gauss–Newton steps of all frames at once, each with its own damping; `ease` is ε of the loss.
    """
    seen = graph.seen
    frame = np.nonzero(seen)[0]
    log_depths, damping, moving = np.log(depths[seen]), np.full(len(seen), 1e-3), np.ones(len(seen), dtype=bool)
    left, jacobian = residuals(graph, log_depths, lengths)
    costs = _costs(graph, left, ease)
    for _ in range(FRAME_ITERATIONS):
        pulse()
        own = jacobian[:, : len(log_depths)]
        weighted = sparse.csr_matrix(sparse.diags(weights_of(left, ease)) @ own)
        normal, gradient = (own.T @ weighted).tocsr(), np.zeros(seen.shape)
        gradient[seen] = weighted.T @ left
        diagonal = normal.diagonal()
        diagonal = diagonal * (1 + damping[frame]) + 1e-12 * float(diagonal.max())
        move = np.linalg.solve(blocks_of(graph, normal, diagonal), gradient[:, :, None])[:, :, 0][seen]
        move = np.clip(move, -MAX_STEP, MAX_STEP)
        after = residuals(graph, log_depths - move, lengths)
        lower = _costs(graph, after[0], ease)
        better = moving & (lower < costs)
        moving &= np.where(better, costs - lower > CONVERGED * costs, damping < MOST_DAMPED)
        costs = np.where(better, lower, costs)
        damping *= np.where(better, 0.1, 10.0)
        log_depths = np.where(better[frame], log_depths - move, log_depths)
        if not moving.any():
            break
        left, jacobian = residuals(graph, log_depths, lengths)
    found = np.zeros(seen.shape)
    found[seen] = np.exp(log_depths)
    return found, costs


def _costs(graph: SurfaceGraph, left: Floats, ease: float) -> Floats:
    """Return the mean loss of the edges of every frame, shape `(F,)`; 0 where it shows none."""
    frame = graph.pairs[0]
    pairs = np.bincount(frame, minlength=len(graph.seen))
    return np.bincount(frame, losses_of(left, ease), minlength=len(graph.seen)) / np.maximum(pairs, 1)


def similar_frames(graph: SurfaceGraph, count: int) -> Indices:
    """Return the most similar other frames of every frame, the most similar first, shape `(F, count)`, fewer columns in short sequences."""
    frames = len(graph.seen)
    together = max(1, CHUNK_OBSERVATIONS // frames)
    found = [
        np.argsort(unlikeness(graph, some, itself=False), axis=1, kind="stable")[:, : min(count, frames - 1)]
        for some in np.split(np.arange(frames), range(together, frames, together))
    ]
    return np.concatenate(found)


def unlikeness(graph: SurfaceGraph, some: Indices, *, itself: bool = True) -> Floats:
    """Return the mean squared difference of rays between the frames `some` and all frames, after removing its mean, shape `(N, F)`.

    Infinite where fewer than two points are visible in both frames and, unless `itself`, between a frame and itself.
    """
    seen = graph.seen.astype(np.float64)
    rays = graph.rays[..., :2] * seen[..., None]
    count = seen[some] @ seen.T
    shared = np.maximum(count, 1.0)
    square = np.zeros(count.shape)
    for axis in (0, 1):
        ray = rays[..., axis]
        shift = (ray[some] @ seen.T - seen[some] @ ray.T) / shared
        apart = np.square(ray)[some] @ seen.T + seen[some] @ np.square(ray).T - 2 * ray[some] @ ray.T
        square += apart / shared - np.square(shift)
    square[count < 2] = np.inf
    if not itself:
        square[np.arange(len(some)), some] = np.inf
    return square

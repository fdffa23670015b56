"""Tracks once more, from where the whole film leads to expect every point.

A frame alone does not tell a wrong match from a right one. Together the frames do: the paths of all points lie near a space of few
dimensions, in which a path is determined by the frames that match well (Irani, Multi-frame correspondence estimation using subspace
constraints, 2002; Garg, Roussos, Agapito, 2013). Every frame is registered again from the paths in this space, and points are
looked for again where they had been lost.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from pliant.solver import Tracks
from pliant.solver.tracks.completion import choose_points, coefficients_of, fit_basis, predict
from pliant.solver.tracks.normalization import normalize
from pliant.tracking.appearance import Appearance
from pliant.tracking.chaining import Chain, OnFrame, Read
from pliant.tracking.errors import TrackingStopped
from pliant.tracking.flow import Bools, Floats
from pliant.tracking.registration import Registration


def expected(chained: Chain) -> Floats:
    """Return where the paths of all points in a space of few dimensions lead, shape `(F, P, 2)`, from places weighted by their confidence.

    The number of dimensions is the one that predicts held-out places best.
    """
    normalized = normalize(Tracks.from_arrays(chained.points, chained.confidence))
    points, weight = normalized.points, np.asarray(normalized.visible)
    random = np.random.default_rng(0)
    chosen = choose_points(weight, random)
    basis, spread, scale = fit_basis(points[:, chosen], weight[:, chosen], random)
    coefficients, _ = coefficients_of(points, weight, basis, spread, scale, sweeps=4, with_moment=False)
    paths = predict(basis, coefficients) * normalized.unit + normalized.centroid[:, None]
    return np.asarray(paths, dtype=np.float32)


def track_again(
    read: Read,
    chained: Chain,
    template: int,
    appearance: Appearance,
    registration: Registration,
    *,
    pool: ThreadPoolExecutor,
    on_frame: OnFrame,
    should_stop: Callable[[], bool],
) -> Chain:
    """Register every frame again from the expected places; points that look like the template there are visible again.

    Parameters
    ----------
    chained
        From `chain`, whose other arguments these are.

    Raises
    ------
    TrackingStopped
        `should_stop` returned True.
    """
    if should_stop():
        raise TrackingStopped
    paths = expected(chained)

    def again(t: int) -> tuple[Floats, Bools, Floats]:
        frame = read(t)
        like = appearance.agrees(frame, paths[t], np.ones(len(paths[t]), dtype=bool))
        points, variance = registration.refine(frame, paths[t], chained.variance[t], like | chained.visible[t])
        return points, appearance.agrees(frame, points, like | chained.visible[t]), variance

    result = Chain(chained.points.copy(), chained.visible.copy(), chained.variance.copy())
    found = {t: pool.submit(again, t) for t in range(len(paths)) if t != template}
    try:
        for t, future in found.items():
            if should_stop():
                raise TrackingStopped
            points, visible, variance = future.result()
            result.points[t], result.visible[t], result.variance[t] = points, visible, variance
            on_frame(t, points, visible)
    finally:
        for future in found.values():
            future.cancel()
    return result

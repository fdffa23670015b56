"""Model order: the number of modes and the starting noise, chosen by held-out negative log likelihood.

A covariance over F frames with many modes, learned from few points, fits those points only: it explains their noise
by modes. In addition, EM changes the noise slowly: from a low start, the random walk absorbs strong noise; from a high
start, fine deformation counts as noise. If the tracks are rougher than smooth motion, a covariance learned from one half
of the points is scored on the other, and vice versa, with both starts and a growing number of modes.

Without noise, additional modes do no harm and keep deformation out of the cameras, so their number is not limited.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.model.expectation_maximisation import MAX_MODES, ModelOrder, annealed
from pliant.solver.model.image_density import negative_log_likelihoods
from pliant.solver.model.marginal_likelihood import NOISE_STD_FLOOR
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats
from pliant.solver.tracks.completion import ranks
from pliant.solver.tracks.frame_selection import evenly_spread
from pliant.solver.tracks.matrix import columns, gram_of
from pliant.solver.tracks.noise import typical_roughness

MODE_COUNTS = (0, 2, 4, 8, 16, 32, MAX_MODES)
"""Numbers of modes that are compared."""

JUDGED_FRAMES = 80
"""Maximum number of frames used for the comparison, evenly spread over longer sequences."""

JUDGED_ITERATIONS = 40
"""EM rounds from scratch for each number of modes: enough that further rounds gain less than modes do."""

MIN_NLL_GAIN = 0.01
"""Difference of the held-out negative log likelihood, per point and frame, below which two orders count as equal."""

MIN_JUDGED_POINTS = 8
"""Minimum number of points for a comparison."""


def select_model_order(
    sample: Floats,
    projections: Floats,
    *,
    ordered: bool = True,
    seed: int = 0,
    should_stop: ShouldStop = never,
) -> ModelOrder:
    """Return the order that the sample supports: no limit where there is no noise.

    Parameters
    ----------
    sample : array, shape (F, S, 2)
        Sampled points of centred, complete tracks, normalized units.
    projections : array, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    ordered : bool
        False for photographs in no order.
    seed : int
        Seed of the split into halves.
    should_stop : callable, optional
        Called after every round of EM; once it returns True, orders not yet scored are not considered.
    """
    frames, count = sample.shape[:2]
    if count < MIN_JUDGED_POINTS or typical_roughness(sample) < NOISE_STD_FLOOR:
        return ModelOrder(ordered=ordered)
    used = evenly_spread(frames, JUDGED_FRAMES)
    rows = columns(sample[used])
    order = np.argsort(ranks(sample))[np.random.default_rng(seed).permutation(count)]
    one, other = rows[:, order[0::2]], rows[:, order[1::2]]
    quiet_start, noisy_start = (
        (
            _judged(one, other, projections[used], each, should_stop=should_stop)
            + _judged(other, one, projections[used], each, should_stop=should_stop)
        )
        / 2
        for each in (ModelOrder(ordered=ordered), ModelOrder(noisy_start=True, ordered=ordered))
    )
    enough = min(float(quiet_start.min()), float(noisy_start.min())) + MIN_NLL_GAIN
    better = noisy_start if noisy_start.min() <= enough else quiet_start
    return ModelOrder(_counts(len(used))[int(np.flatnonzero(better <= enough)[-1])], better is noisy_start, ordered)


def _counts(frames: int) -> list[int]:
    """Return the `MODE_COUNTS` that differ for this number of frames; there are fewer modes than frames."""
    return [count for count in MODE_COUNTS[:-1] if count < frames - 1] + [MAX_MODES]


def _judged(
    points: Floats,
    other: Floats,
    projections: Floats,
    model_order: ModelOrder,
    *,
    should_stop: ShouldStop,
) -> Floats:
    """Return the held-out negative log likelihood for each number of modes; `model_order` determines the start."""
    frames = len(projections)
    gram = gram_of(points)
    counts = _counts(frames)
    energies = np.full(len(counts), np.inf)
    for index, max_modes in enumerate(counts):
        if index and should_stop():
            break
        limited = replace(model_order, max_modes=max_modes)
        found = annealed(gram, projections, limited, iterations=JUDGED_ITERATIONS, should_stop=should_stop)
        energies[index] = held_out_nll(found, projections, other)
    return energies


def held_out_nll(covariance: ShapeCovariance, projections: Floats, other: Floats) -> float:
    """Return the mean negative log likelihood of held-out points, per point and frame.

    The least probable tenth of them is excluded: it may contain gross outliers that completion left.
    """
    each = np.sort(negative_log_likelihoods(covariance.image_model(projections), other))
    return float(each[: -(-9 * len(each) // 10)].mean())

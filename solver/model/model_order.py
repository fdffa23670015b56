"""How many modes of deformation the points can tell, and how much noise to begin with: what suits points that were not learned from.

A covariance over F frames with many modes, learned from few points, explains those points and no others: it takes their noise for
modes. And expectation maximisation moves the noise slowly: from a small one, strong noise ends as a random walk of every point; from
a large one, fine deformation as noise. Where tracks are rougher than smooth motion is, one half of the points is therefore learned from and
the other judged, then the other way round, with both starts and more and more modes. Measured with noise of .09 RMS radii on faces of
99 frames: .003 from the small start, .074 from the large one.

Without noise more modes do no harm, and keep deformation out of the cameras: measured, mocap of 41 points .012 instead of .018.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pliant.solver.model.image_density import negative_log_likelihoods
from pliant.solver.model.marginal_likelihood import NOISE_FLOOR
from pliant.solver.model.shape_covariance import MOST_MODES, ShapeCovariance, annealed
from pliant.solver.records import Floats
from pliant.solver.tracks.noise import typical_roughness

COUNTS = (0, 2, 4, 8, 16, 32, MOST_MODES)
"""Numbers of modes tried."""

JUDGED_FRAMES = 80
"""Longer sequences are judged on this many of their frames, evenly spread."""

ROUNDS = 40
"""Rounds of expectation maximisation with each number, from scratch: what further rounds gain must not pass for what modes do."""

GAIN = 0.01
"""Logarithms of the likelihood of the other points, per point and frame, that differ by less are as good."""

FEWEST = 8
"""With fewer points nothing is judged."""


@dataclass(frozen=True, slots=True)
class Support:
    """What to learn the covariance with."""

    most: int = MOST_MODES
    """Modes at most."""

    noisy: bool = False
    """Whether to begin with all that is rough in the tracks as noise."""


def supported(
    sample: Floats,
    pairs: Floats,
    *,
    spoiled: bool = False,
    seed: int = 0,
    should_stop: Callable[[], bool] | None = None,
) -> Support:
    """Return what the sample supports: all modes where there is neither noise nor what is left of outliers to mistake for one.

    Parameters
    ----------
    sample : array, shape (F, S, 2)
        Some points of centred, complete tracks, normalised units.
    pairs : array, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    spoiled : bool
        Outliers were found: some that were not are still in the sample.
    seed : int
        Deals the points into halves.
    should_stop : callable, optional
        Asked after every round of learning; once it returns True, what was not judged counts as improbable.
    """
    frames, count = sample.shape[:2]
    if count < FEWEST or not (spoiled or typical_roughness(sample) >= NOISE_FLOOR):
        return Support()
    used = np.unique(np.linspace(0, frames - 1, min(frames, JUDGED_FRAMES)).round().astype(np.intp))
    rows = sample[used].transpose(0, 2, 1).reshape(2 * len(used), count)
    order = np.random.default_rng(seed).permutation(count)
    one, other = rows[:, order[0::2]], rows[:, order[1::2]]
    quiet, noisy = (
        (
            _judged(one, other, pairs[used], noisy=each, should_stop=should_stop)
            + _judged(other, one, pairs[used], noisy=each, should_stop=should_stop)
        )
        / 2
        for each in (False, True)
    )
    enough = min(float(quiet.min()), float(noisy.min())) + GAIN
    better = noisy if noisy.min() <= enough else quiet
    return Support(_counts(len(used))[int(np.flatnonzero(better <= enough)[-1])], better is noisy)


def _counts(frames: int) -> list[int]:
    """Return those of `COUNTS` that differ, for there are fewer modes than frames."""
    return [count for count in COUNTS[:-1] if count < frames - 1] + [MOST_MODES]


def _judged(
    points: Floats, other: Floats, pairs: Floats, *, noisy: bool, should_stop: Callable[[], bool] | None
) -> Floats:
    """Return how improbable other points are for each count of modes."""
    frames = len(pairs)
    gram = points @ points.T / points.shape[1]
    counts = _counts(frames)
    energies = np.full(len(counts), np.inf)
    for index, most in enumerate(counts):
        if index and should_stop is not None and should_stop():
            break
        found = annealed(gram, pairs, most=most, noisy=noisy, iterations=ROUNDS, should_stop=should_stop)
        energies[index] = improbability(found, pairs, other)
    return energies


def improbability(covariance: ShapeCovariance, pairs: Floats, other: Floats) -> float:
    """Return the negative logarithm of the likelihood of points that were not learned from, per point and frame.

    The tenth of them that is least probable does not count: what completion left of gross outliers.
    """
    each = np.sort(negative_log_likelihoods(covariance.image_model(pairs), other))
    return float(each[: -(-9 * len(each) // 10)].mean())

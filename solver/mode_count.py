"""How many modes of deformation the points can tell: as many as make points probable that were not learned from.

A covariance over F frames with many modes, learned from few points, explains those points and no others: it takes their noise for
modes. Where tracks are rougher than smooth motion is, one half of the points is therefore learned from and the other judged, then
the other way round, with more and more modes. Without noise more modes do no harm, and keep deformation out of the cameras: measured,
mocap of 41 points .012 instead of .018.
"""

from __future__ import annotations

import numpy as np
from pliant.solver.covariance import MOST_MODES, QUIET, WARM, begin, improve
from pliant.solver.likelihood import NOISE_FLOOR
from pliant.solver.noise import roughness, typical_roughness
from pliant.solver.records import Floats
from scipy import linalg

COUNTS = (0, 2, 4, 8, 16, 32, MOST_MODES)
"""Numbers of modes tried."""

JUDGED_FRAMES = 80
"""Longer sequences are judged on this many of their frames, evenly spread."""

ROUNDS = 40
"""Rounds of expectation maximisation with each number, from scratch: what further rounds gain must not pass for what modes do."""

GAIN = 0.004
"""What further modes must add to the logarithm of the likelihood of the other points, per point and frame."""

FEWEST = 8
"""With fewer points nothing is judged."""


def modes_supported(sample: Floats, pairs: Floats) -> int:
    """Return the most modes that the sample supports; all of them where there is no noise to mistake for one.

    Parameters
    ----------
    sample : array, shape (F, S, 2)
        Some points of centred, complete tracks, normalised units.
    pairs : array, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    """
    frames, count = sample.shape[:2]
    if count < FEWEST or typical_roughness(sample) < NOISE_FLOOR:
        return MOST_MODES
    used = np.unique(np.linspace(0, frames - 1, min(frames, JUDGED_FRAMES)).round().astype(np.intp))
    rows = sample[used].transpose(0, 2, 1).reshape(2 * len(used), count)
    order = np.random.default_rng(0).permutation(count)
    one, other = rows[:, order[0::2]], rows[:, order[1::2]]
    energies = (_judged(one, other, pairs[used]) + _judged(other, one, pairs[used])) / 2
    enough = energies <= energies.min() + GAIN
    return int(COUNTS[int(np.argmax(enough))])


def _judged(points: Floats, other: Floats, pairs: Floats) -> Floats:
    """Return the negative logarithm of the likelihood of other points, per point and frame, for each of `COUNTS`.

    The noise starts large: from a small start many modes would take it for deformation. The tenth of the other points that is least
    probable does not count: what completion left of gross outliers.
    """
    frames = len(pairs)
    learned = points @ points.T / points.shape[1]
    energies = np.full(len(COUNTS), np.inf)
    for index, most in enumerate(COUNTS):
        start = begin(learned, pairs, noise=max(roughness(learned), QUIET), most=most)
        covariance = improve(start, learned, pairs, iterations=ROUNDS, warm=WARM, most=most)
        factor = linalg.cho_factor(covariance.of_image(pairs), lower=True)
        log_det = 2 * float(np.log(np.diag(factor[0])).sum())
        each = np.sort((other * linalg.cho_solve(factor, other)).sum(axis=0))
        energies[index] = 0.5 * (log_det + float(each[: -(-9 * len(each) // 10)].mean())) / frames
    return energies

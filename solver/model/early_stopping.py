"""When to stop learning the covariance: once points that were not learned from become less probable.

With fewer points than image coordinates, P < 2F, the Gram matrix of the tracks has no full rank, and the likelihood has no maximum: it
grows as long as a covariance is the more certain that there is nothing but these points. Expectation maximisation finds first what they
have in common, as all the tracks show it, and last what hangs on single points and on the depth of single frames. So three times
two thirds of the points are learned from, the third is judged after every round, and all points are then learned from for as many
rounds as were good for the others. Measured, all points seen: landmarks of a face .0204 → .0144, mocap of a dance .112 → .101, a
dinosaur of 49 points .131 → .124; a walk .112 → .118.

Where few modes are all there is (a shark of 91 points, 5 modes) the other points become more probable to the end, and nothing is stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np
from pliant.solver.model.model_order import FEWEST, GAIN, Support, improbability
from pliant.solver.model.shape_covariance import (
    DRIFT_FLOOR,
    MOST_MODES,
    WARM,
    ShapeCovariance,
    learned,
    rounds,
    scratch,
)
from pliant.solver.records import Floats
from pliant.solver.tracks.completion import SAMPLE

FOLDS = 3
"""Parts into which the points are dealt."""

ROUNDS = 40
"""Rounds judged at most. What still gains by the last of them is learned in full."""

ANNEALED, COLD = np.geomspace(WARM, DRIFT_FLOOR, ROUNDS), np.full(ROUNDS, DRIFT_FLOOR)
"""The floors of τ of either way of learning."""

HOPELESS = 1.0
"""Logarithms of the likelihood per point and frame by which the other points may become less probable before nobody looks further."""


def learned_in_time(
    sample: Floats,
    gram: Floats,
    pairs: Floats,
    support: Support,
    *,
    seed: int = 0,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[ShapeCovariance, str]:
    """Return the covariance learned from scratch, for as many rounds as suit points that were not learned from, and the reason.

    Parameters
    ----------
    sample : array, shape (F, S, 2)
        Some points of centred, complete tracks, normalised units; judged only if they are all there are and fewer than 2F.
    gram, pairs
        As for `pliant.solver.model.shape_covariance.learned`.
    support : Support
        Modes at most, and the noise to begin with.
    seed : int
        Deals out the points.
    should_stop : callable, optional
        Asked between rounds; once it says True, no more of them are judged.
    """
    frames, count = sample.shape[:2]
    if FEWEST <= count < min(2 * frames, SAMPLE):
        points = sample.transpose(0, 2, 1).reshape(2 * frames, count)
        ways = [(each, floors) for each in sorted({support.most, MOST_MODES}) for floors in (ANNEALED, COLD)]
        paths = [
            _judged(points, pairs, replace(support, most=most), floors, seed, should_stop) for most, floors in ways
        ]
        best = min(paths, key=min)
        if min(best) < min(path[-1] for path in paths) - GAIN:
            most, floors = ways[paths.index(best)]
            start = scratch(gram, pairs, most, noisy=support.noisy)
            path = rounds(start, gram, pairs, floors=floors, most=most)
            number = best.index(min(best)) + 1
            told = f"learned in {number} rounds, for more would make points that are not learned from less probable."
            covariance = next(islice(path, number - 1, None))
            return covariance, described(covariance, told)
    told = f"more than {support.most} modes, learned from some points, do not make the others more probable."
    covariance = learned(gram, pairs, most=support.most, noisy=support.noisy, should_stop=should_stop)
    return covariance, described(covariance, told if support.most < MOST_MODES else "")


def described(covariance: ShapeCovariance, more: str = "") -> str:
    """Return a sentence about what was learned."""
    found = f"{covariance.modes.shape[1]} modes of deformation, noise of {covariance.noise**0.5:.2g} RMS radii"
    return f"{found}; {more}" if more else f"{found}."


def _judged(
    points: Floats,
    pairs: Floats,
    support: Support,
    floors: Floats,
    seed: int,
    should_stop: Callable[[], bool] | None,
) -> list[float]:
    """Return how improbable points that were not learned from are after every round, until it is hopeless."""
    part = np.random.default_rng(seed).permutation(points.shape[1]) % FOLDS
    paths, others = [], []
    for fold in range(FOLDS):
        own = points[:, part != fold]
        gram = own @ own.T / own.shape[1]
        start = scratch(gram, pairs, support.most, noisy=support.noisy)
        paths.append(rounds(start, gram, pairs, floors=floors, most=support.most))
        others.append(points[:, part == fold])
    found: list[float] = []
    for covariances in zip(*paths, strict=True):
        energies = [improbability(each, pairs, other) for each, other in zip(covariances, others, strict=True)]
        found.append(sum(energies) / FOLDS)
        if found[-1] > min(found) + HOPELESS or (should_stop is not None and should_stop()):
            break
    return found

"""Early stopping of the shape covariance: stop EM when held-out points become less probable.

With fewer points than image coordinates, P < 2F, the Gram matrix of the tracks is rank deficient and the likelihood
is unbounded: it keeps growing as the covariance concentrates on the given points. Expectation maximisation learns
common structure first, and idiosyncrasies of single points and of the depth of single frames last. The points are
therefore split into three folds. Each fold in turn is held out and scored after every round of EM on the other two. EM on
all points then runs for the number of rounds with the lowest held-out negative log likelihood.

If the motion has few modes, the held-out likelihood improves to the end and EM is not stopped early.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.model.expectation_maximisation import (
    ANNEALING_START,
    MAX_MODES,
    WALK_VARIANCE_FLOOR,
    ModelOrder,
    learned,
    rounds,
    scratch,
)
from pliant.solver.model.model_order import MIN_JUDGED_POINTS, MIN_NLL_GAIN, held_out_nll
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats
from pliant.solver.tracks.completion import MAX_SAMPLE_POINTS
from pliant.solver.tracks.matrix import columns, gram_of

FOLDS = 3
"""Folds of the cross-validation over points."""

MAX_JUDGED_ROUNDS = 40
"""Maximum number of EM rounds that are scored. If the last one is still the best, EM runs to its usual end."""

ANNEALED_FLOORS, CONSTANT_FLOORS = (
    np.geomspace(ANNEALING_START, WALK_VARIANCE_FLOOR, MAX_JUDGED_ROUNDS),
    np.full(MAX_JUDGED_ROUNDS, WALK_VARIANCE_FLOOR),
)
"""Floors of τ per round, with annealing and without; variance per point in normalized units."""

MAX_NLL_RISE = 1.0
"""Rise of the held-out negative log likelihood above its minimum, per point and frame, that ends the scoring."""


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """The rounds of EM from scratch that held-out points favour."""

    model_order: ModelOrder

    floors: Floats
    """Floors of τ of the rounds, shape `(n,)`."""

    def learned(self, gram: Floats, projections: Floats) -> ShapeCovariance:
        """Return the covariance after these rounds; arguments as for `learn_with_early_stopping`."""
        return _last(_rounds(gram, projections, self.model_order, self.floors))


def learn_with_early_stopping(
    sample: Floats,
    gram: Floats,
    projections: Floats,
    model_order: ModelOrder,
    *,
    seed: int = 0,
    should_stop: ShouldStop = never,
) -> tuple[ShapeCovariance, str]:
    """Return the covariance learned from scratch in the number of rounds that held-out points favour, and a sentence.

    Parameters
    ----------
    sample : array, shape (F, S, 2)
        Sampled points of centred, complete tracks, normalized units; held out only if they are all points and fewer than 2F.
    gram : array, shape (2F, 2F)
        W Wᵀ / P of centred, complete tracks, normalized units.
    projections : array, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    model_order : ModelOrder
        Maximum number of modes, and the starting noise.
    seed : int
        Seed of the folds.
    should_stop : callable, optional
        Called between rounds; once it returns True, scoring ends.
    """
    early = schedule(sample, projections, model_order, seed=seed, should_stop=should_stop)
    if early is not None:
        covariance = early.learned(gram, projections)
        rounds = "1 round" if len(early.floors) == 1 else f"{len(early.floors)} rounds"
        reason = f"learned in {rounds}; more would make held-out points less probable."
        return covariance, described(covariance, reason)
    covariance = learned(gram, projections, model_order, should_stop=should_stop)
    reason = (
        f"more than {model_order.max_modes} modes, learned from some points, do not make other points more probable."
    )
    return covariance, described(covariance, reason if model_order.max_modes < MAX_MODES else "")


def schedule(
    sample: Floats,
    projections: Floats,
    model_order: ModelOrder,
    *,
    seed: int,
    should_stop: ShouldStop,
) -> Schedule | None:
    """Return the rounds that held-out points favour; None where they favour all rounds. Arguments as for `learn_with_early_stopping`."""
    frames, count = sample.shape[:2]
    if not MIN_JUDGED_POINTS <= count < min(2 * frames, MAX_SAMPLE_POINTS):
        return None
    points = columns(sample)
    ways = [
        Schedule(replace(model_order, max_modes=each), floors)
        for each in sorted({model_order.max_modes, MAX_MODES})
        for floors in (ANNEALED_FLOORS, CONSTANT_FLOORS)
    ]
    paths = [_judged(points, projections, each, seed, should_stop) for each in ways]
    best = min(paths, key=min)
    if not min(best) < min(path[-1] for path in paths) - MIN_NLL_GAIN:
        return None
    way = ways[paths.index(best)]
    return replace(way, floors=way.floors[: best.index(min(best)) + 1])


def described(covariance: ShapeCovariance, more: str = "") -> str:
    """Return a sentence with the number of modes and the noise."""
    count = covariance.modes.shape[1]
    found = f"{count} mode{'' if count == 1 else 's'} of deformation, noise of {covariance.noise_variance**0.5:.2g} RMS radii"
    return f"{found}; {more}" if more else f"{found}."


def _judged(points: Floats, projections: Floats, way: Schedule, seed: int, should_stop: ShouldStop) -> list[float]:
    """Return the mean held-out negative log likelihood after every round, until it has risen by `MAX_NLL_RISE`."""
    part = np.random.default_rng(seed).permutation(points.shape[1]) % FOLDS
    paths, others = [], []
    for fold in range(FOLDS):
        own = points[:, part != fold]
        paths.append(_rounds(gram_of(own), projections, way.model_order, way.floors))
        others.append(points[:, part == fold])
    found: list[float] = []
    for covariances in zip(*paths, strict=True):
        energies = [held_out_nll(each, projections, other) for each, other in zip(covariances, others, strict=True)]
        found.append(sum(energies) / FOLDS)
        if found[-1] > min(found) + MAX_NLL_RISE or should_stop():
            break
    return found


def _rounds(gram: Floats, projections: Floats, model_order: ModelOrder, floors: Floats) -> Iterator[ShapeCovariance]:
    """Yield the covariance after every round from scratch."""
    start = scratch(gram, projections, model_order)
    return rounds(start, gram, projections, floors=floors, max_modes=model_order.max_modes)


def _last(covariances: Iterator[ShapeCovariance]) -> ShapeCovariance:
    *_, last = covariances
    return last

"""Rejection of gross outliers before the shapes are fitted.

With a loss of slope 1, an outlier of one RMS radius costs as much as the noise of a hundred good observations, so a
prior weighted for the noise follows outliers. A prior weighted for the outliers resists them but smooths. The fit
therefore runs twice: a stiff fit identifies the outliers, then the final fit, weighted for the noise, runs without
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pliant.solver.energy.objective import residuals
from pliant.solver.energy.problem import Problem, Weights
from pliant.solver.shapes.irls import init, no_higher, step
from pliant.solver.shapes.state import State
from pliant.solver.tracks.noise import weighted_median

STIFFNESS_PER_OUTLIER_SHARE = 0.5
"""λ1 of the stiff fit divided by the share of outliers. With 10 % outliers on faces and animals, λ1 from .01 to .1 gives
about the same error, lowest at .05."""

MAX_STIFF_REWEIGHTINGS = 12
"""Maximum number of reweightings of the stiff fit."""

STIFF_FIT_TOLERANCE = 1e-3
"""Relative decrease of the energy below which the stiff fit ends."""

MIN_OUTLIER_DISTANCE = 0.05
"""Residual, normalized units, below which an observation is never rejected."""

MIN_REJECTED_STDS = 8.0
"""Residual, in robust standard deviations, below which an observation is never rejected."""


def _stiffness(weights: Weights, outliers: float) -> float:
    """Return the factor on the prior's weight at which this share of outliers does not bend the fit."""
    return max(STIFFNESS_PER_OUTLIER_SHARE * outliers / weights.temporal, 1.0)


def reject_outliers(
    problem: Problem, state: State, outliers: float, *, should_stop: Callable[[], bool] | None = None
) -> tuple[Problem, State]:
    """Return the problem without its gross outliers, and a state of it to start from.

    Parameters
    ----------
    problem, state
        With a Gaussian prior of some weight.
    outliers : float
        Their share in the tracks, estimated.
    should_stop : callable, optional
        Called between units of work; once it returns True, nothing is rejected.
    """
    assert problem.quadratic is not None
    weights = problem.weights
    stiffer = _stiffness(weights, outliers)
    stiff = replace(
        problem,
        weights=replace(weights, temporal=weights.temporal * stiffer, spatial=weights.spatial * stiffer),
        quadratic=problem.quadratic.scaled(stiffer),
    )
    before = init(stiff, state.shapes, state.translations)
    for _ in range(MAX_STIFF_REWEIGHTINGS):
        if should_stop is not None and should_stop():
            return problem, state
        after = no_higher(before, step(stiff, before, tolerance=STIFF_FIT_TOLERANCE, should_stop=should_stop))
        settled = before.objective - after.objective <= STIFF_FIT_TOLERANCE * before.objective
        before = after
        if settled:
            break
    left = residuals(problem, before.shapes, before.translations)
    length = np.hypot(left[:, 0], left[:, 1])
    seen = problem.confidence > 0
    typical = weighted_median(length[seen], problem.confidence[seen]) / 1.1774
    kept = np.where(length <= max(MIN_OUTLIER_DISTANCE, MIN_REJECTED_STDS * typical), problem.confidence, 0).astype(
        problem.confidence.dtype
    )
    rejected_problem = replace(problem, confidence=kept)
    return rejected_problem, init(rejected_problem, before.shapes, before.translations)

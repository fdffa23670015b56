"""Gross outliers left out before the shapes are fitted finely.

A loss of slope 1 makes an outlier of one RMS radius as dear as the misfit of all the noise in a hundred good observations, so that
a prior weighed against the noise gives way to outliers. Weighed against the outliers it resists them, but smooths. Therefore twice:
stiff first, which shows what does not belong; then without that, as finely as the noise allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pliant.solver.energy.objective import residuals
from pliant.solver.energy.problem import Problem, Weights
from pliant.solver.shapes.irls import init, no_higher, step
from pliant.solver.shapes.state import State

STIFF = 0.5
"""λ1 of the stiff fit over the share of outliers. Measured: 10 % on faces and animals, λ1 from 0.01 to 0.1 alike, best at 0.05."""

STEPS = 12
"""Reweightings of the stiff fit at most."""

SETTLED = 1e-3
"""It ends where the energy's relative change falls below this."""

GROSS = 0.05
"""Normalised units: nothing nearer to its fit is called an outlier,"""

FAR = 8.0
"""nor anything within this many robust standard deviations."""


def _stiffness(weights: Weights, outliers: float) -> float:
    """Return how many times stiffer than for the noise a fit must be that such a share of outliers does not bend."""
    return max(STIFF * outliers / weights.temporal, 1.0)


def without_outliers(
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
        Asked between units of work; once it says True, nothing is left out.
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
    for _ in range(STEPS):
        if should_stop is not None and should_stop():
            return problem, state
        after = no_higher(before, step(stiff, before, should_stop=should_stop))
        settled = before.objective - after.objective <= SETTLED * before.objective
        before = after
        if settled:
            break
    left = residuals(problem, before.shapes, before.translations)
    length = np.hypot(left[:, 0], left[:, 1])
    typical = float(np.median(length[problem.confidence > 0])) / 1.1774
    kept = np.where(length <= max(GROSS, FAR * typical), problem.confidence, 0).astype(problem.confidence.dtype)
    trimmed = replace(problem, confidence=kept)
    return trimmed, init(trimmed, before.shapes, before.translations)

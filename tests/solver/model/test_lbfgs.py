"""L-BFGS finds the minimum of a quadratic, and stops when asked to."""

from __future__ import annotations

import numpy as np
from pliant.solver.model.lbfgs import minimize
from pliant.solver.pulse import never

CURVATURES = np.geomspace(1, 100, 8)


def quadratic(x: np.ndarray) -> tuple[float, np.ndarray]:
    return float(CURVATURES @ np.square(x - 1)), 2 * CURVATURES * (x - 1)


def test_the_minimum_of_a_quadratic_is_found() -> None:
    found, value = minimize(quadratic, np.zeros(8), should_stop=never, maxiter=100, ftol=1e-15)
    np.testing.assert_allclose(found, 1, atol=1e-4)
    assert 0 <= value < 1e-7


def test_a_stopped_minimisation_returns_what_it_has_reached() -> None:
    calls = iter([False, True])
    found, value = minimize(quadratic, np.zeros(8), should_stop=lambda: next(calls), maxiter=100)
    assert value == quadratic(found)[0]
    assert 1e-6 < value < quadratic(np.zeros(8))[0]

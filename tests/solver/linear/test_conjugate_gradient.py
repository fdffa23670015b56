"""Conjugate gradients: the reported decrease, and when iterations end."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pliant.solver.linear.conjugate_gradient import Solved, conjugate_gradient

SHAPE = (4, 3, 5)
RANDOM = np.random.default_rng(0)
ROOT = RANDOM.standard_normal((60, 60))
MATRIX, B = ROOT @ ROOT.T + np.eye(60), RANDOM.standard_normal(SHAPE)


def product(x: np.ndarray, /, out: np.ndarray | None = None) -> np.ndarray:
    return np.asarray((MATRIX @ x.ravel()).reshape(SHAPE))


def same(x: np.ndarray, /, out: np.ndarray | None = None) -> np.ndarray:
    return x.copy()


def inverse(x: np.ndarray, /, out: np.ndarray | None = None) -> np.ndarray:
    return np.asarray(np.linalg.solve(MATRIX, x.ravel()).reshape(SHAPE))


@pytest.mark.parametrize("iterations", [1, 7, 200])
def test_the_reported_decrease_is_that_of_the_quadratic(iterations: int) -> None:
    found = conjugate_gradient(product, B.copy(), precondition=same, reduction=1e-9, max_iterations=iterations)
    value = float(np.vdot(found.x, product(found.x)) - 2 * np.vdot(B, found.x))
    assert found.decrease == pytest.approx(-value, rel=1e-6)


def test_iterations_end_when_the_remaining_gain_is_negligible() -> None:
    whole = float(np.vdot(B, inverse(B)))  # with M = 𝒜, rᵀM⁻¹r is the remaining gain
    for share, expected in ((1.1, 0), (0.9, 1)):
        found = conjugate_gradient(
            product, B.copy(), precondition=inverse, reduction=1e-9, max_iterations=1, negligible=share * whole
        )
        assert found.iterations == expected


def test_a_stop_is_polled_before_the_first_product_and_in_every_iteration() -> None:
    asked: list[int] = []

    def going_on() -> bool:
        asked.append(len(asked))
        return False

    def solved(should_stop: Callable[[], bool]) -> Solved:
        return conjugate_gradient(
            product, B.copy(), precondition=same, reduction=1e-9, max_iterations=4, should_stop=should_stop
        )

    assert solved(going_on).iterations == 4
    assert len(asked) == 5
    stopped = solved(lambda: True)
    assert stopped.iterations == 0
    assert (stopped.x == 0).all()

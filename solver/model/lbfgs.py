"""Minimisation by L-BFGS (Liu and Nocedal 1989) that can be stopped between iterations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pliant.solver.pulse import ShouldStop
from pliant.solver.records import Floats
from scipy import optimize

MEMORY = 20
"""Number of past steps from which the inverse Hessian is approximated."""


def minimize(
    objective: Callable[[Floats], tuple[float, Floats]],
    start: Floats,
    *,
    should_stop: ShouldStop,
    **options: Any,
) -> tuple[Floats, float]:
    """Return the parameters with the least value found, and that value.

    Parameters
    ----------
    objective : callable
        Returns value and gradient.
    start : ndarray, shape (N,)
        Parameters to start from.
    should_stop : callable
        Called after each iteration; once it returns True, the parameters reached are returned.
    **options
        Options of SciPy's L-BFGS-B, such as `maxiter`.
    """

    def stop_check(xk: Floats) -> None:  # noqa: ARG001 - SciPy calls it by this name
        if should_stop():
            raise StopIteration

    given: Any = {"maxcor": MEMORY, **options}
    found = optimize.minimize(objective, start, jac=True, method="L-BFGS-B", callback=stop_check, options=given)
    return np.asarray(found.x), float(found.fun)

"""Errors of the solver.

    SolverError                 base: catch this one
    ├── InvalidInput            invalid input: states expected and got, and what to do
    │   └── InvalidSettings     one of the settings is out of its range
    └── NotFinite               the arithmetic overflowed; no result

Not converging is not an error: see `pliant.solver.Outcome`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pliant.schemas.invalid import Invalid

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class SolverError(Exception):
    """The solver failed."""


class NotFinite(SolverError):
    """Overflow: the energy is infinite or NaN. Never returned as a result."""

    code = "not_finite"

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}. Check the tracks for absurdly large values, or solve in float64.")


class InvalidInput(Invalid, SolverError):
    """An input is invalid; ``code``, ``field``, ``expected``, ``got`` and ``hint`` are attributes."""


class InvalidSettings(InvalidInput):
    """A setting is out of its range, or two settings contradict each other."""


def wrong_input(field: str, code: str, expected: str, got: str, hint: str) -> InvalidInput:
    """Return the error of a wrong input; all parts are required, so they have an order instead of keywords."""
    return InvalidInput(code, field=field, expected=expected, got=got, hint=hint)


def shape_text(array: NDArray[np.generic]) -> str:
    """Return the shape of an array as messages state it, e.g. ``(10, 3)``."""
    return "(" + ", ".join(str(n) for n in array.shape) + ")"

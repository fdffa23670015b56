"""Errors of the solver.

    SolverError                 base: catch this one
    ├── InvalidInput            invalid input, with the expected and the actual value and a hint
    │   └── InvalidSettings     a setting is out of its range, or two settings contradict each other
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
    """The arithmetic overflowed: the energy is infinite or NaN."""

    code = "not_finite"

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}. Check the tracks for absurdly large values, or solve in float64.")


class InvalidInput(Invalid, SolverError):
    """An input is invalid; ``code``, ``field``, ``expected``, ``got`` and ``hint`` are attributes."""


class InvalidSettings(InvalidInput):
    """A setting is out of its range, or two settings contradict each other."""


def wrong_input(field: str, code: str, expected: str, got: str, hint: str) -> InvalidInput:
    """Return the error for an invalid input; all arguments are required and therefore positional."""
    return InvalidInput(code, field=field, expected=expected, got=got, hint=hint)


def shape_text(array: NDArray[np.generic]) -> str:
    """Return the shape of an array as text for messages, e.g. ``(10, 3)``."""
    return "(" + ", ".join(str(n) for n in array.shape) + ")"

"""Errors of the solver.

    SolverError                 base: catch this one
    ├── InvalidInput            invalid input: states expected and got, and what to do
    │   └── InvalidSettings     one of the settings is out of its range
    └── NotFinite               the arithmetic overflowed; no result

Not converging is not an error: see `pliant.solver.Outcome`.
"""

from __future__ import annotations

from pliant.schemas.invalid import Invalid


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

"""Errors of the solver.

    SolverError                 base: catch this one
    ├── InvalidInput            invalid input: states expected and got, and what to do
    │   └── InvalidSettings     one of the settings is out of its range
    └── NotFinite               the arithmetic overflowed; no result

Not converging is not an error: see `pliant.solver.Outcome`.
"""

from __future__ import annotations


class SolverError(Exception):
    """The solver failed."""


class NotFinite(SolverError):
    """Overflow: the energy is infinite or NaN. Never returned as a result."""

    code = "not_finite"

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}. Check the tracks for absurdly large values, or solve in float64.")


class InvalidInput(SolverError):
    """An input is invalid.

    Attributes
    ----------
    code : str
        Stable machine-readable name of the fault, e.g. ``"too_few_frames"``.
    field : str
        The input at fault, e.g. ``"tracks"`` or ``"mesh.faces"``.
    expected, got : str
        What was expected and what was given.
    hint : str
        What the user can do about it.
    """

    def __init__(self, code: str, *, field: str, expected: str, got: str, hint: str) -> None:
        super().__init__(f"{field}: expected {expected}, got {got}. {hint}")
        self.code = code
        self.field = field
        self.expected = expected
        self.got = got
        self.hint = hint


class InvalidSettings(InvalidInput):
    """A setting is out of its range, or two settings contradict each other."""

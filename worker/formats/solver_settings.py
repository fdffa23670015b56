"""Solver settings from a job's options."""

from __future__ import annotations

from pliant.schemas.options import SOLVER_FIELDS, Options
from pliant.solver.settings import Settings


def solver_settings(options: Options, *, y_up: bool = False) -> Settings:
    """Return the solver settings of a job's options; `y_up` is True if y points up in the tracks.

    Raises
    ------
    InvalidSettings
        Two options contradict each other.
    """
    values = {name: getattr(options, name) for name in SOLVER_FIELDS}
    values["image_size"] = _pair(options.image_size, "x")
    values["principal_point"] = _pair(options.principal_point, ",")
    return Settings(**values, y_up=y_up)


def _pair(text: str | None, between: str) -> tuple[float, float] | None:
    """Parse two numbers joined by a separator."""
    if text is None:
        return None
    first, second = text.split(between)
    return float(first), float(second)

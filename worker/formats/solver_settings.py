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
    values["image_size"] = options.picture_size
    values["principal_point"] = options.principal_point_xy
    return Settings(**values, y_up=y_up)

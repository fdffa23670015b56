"""Errors of the readers.

pliant.solver.InvalidInput      base: every error has code, field, expected, got and hint
└── AmbiguousInput              several interpretations fit; lists them as choices
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from pliant.schemas.invalid import SIDES
from pliant.solver import InvalidInput

FULL = "a full matrix of real numbers, such as W"
SAVE_MATRIX = "Save the 2F × P matrix, a sparse one after W = full(W): save('tracks.mat', 'W', '-v7')."
"""What files of MATLAB must hold, and how to write them."""

MAX_NAMES, LONGEST_NAME = 10, 40
"""Numbers of arrays that an error lists, and of characters of each name."""


class AmbiguousInput(InvalidInput):
    """Several interpretations of the input fit.

    Attributes
    ----------
    choices : list of dict
        One per interpretation: `layout` as text, `options` that select it, `evidence` for it.
    """

    def __init__(
        self, *, field: str, expected: str, got: str, hint: str, choices: list[dict[str, Any]], code: str = "ambiguous_layout"
    ) -> None:  # fmt: skip
        super().__init__(code, field=field, expected=expected, got=got, hint=hint)
        self.choices = choices


def missing_array(field: str, *, expected: str, there: Mapping[str, tuple[int, ...] | None], hint: str) -> InvalidInput:
    """Return the error for a file without the array that is needed; `there` are the names and, if known, shapes of what it has."""
    listed = [
        name[:LONGEST_NAME] + ("" if shape is None else f" {shape}")
        for name, shape in sorted(there.items())[:MAX_NAMES]
    ]
    more = f" and {len(there) - MAX_NAMES} more" if len(there) > MAX_NAMES else ""
    got = ", ".join(listed) + more or "no array"
    return InvalidInput("missing_array", field=field, expected=expected, got=got, hint=hint)


def too_large(field: str, *, expected: str, got: str) -> InvalidInput:
    """Return the error for an input that exceeds a limit of this installation."""
    return InvalidInput(
        "too_large", field=field, expected=expected, got=got,
        hint="Reduce the input, e.g. fewer frames or points, or ask the operator to raise the limit.",
    )  # fmt: skip


def damaged(field: str, what: str) -> InvalidInput:
    """Return the error for a file whose content does not match its format."""
    return InvalidInput(
        "damaged_file", field=field, expected="a complete, consistent file", got=what, hint="Write the file again."
    )


def refusal_in(answer: bytes, *, with_choices: bool = False) -> InvalidInput | None:
    """Return the error that a contained process answered, None if the answer states none.

    `with_choices` believes its `choices`, which nothing checks.
    """
    try:
        stated = json.loads(answer)
        parts = {name: str(stated[name]) for name in ("code", *SIDES)}
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    if with_choices and stated.get("choices") is not None:
        return AmbiguousInput(**parts, choices=stated["choices"])
    return InvalidInput(**parts)

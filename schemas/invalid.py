"""Base classes of errors: one that can be pickled, and one about invalid values: code, field, expected value, given value and remedy.

The attributes are members of a problem document. Only the standard library is imported, so that the solver can use it, too.
"""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from typing import Any

SIDES = ("field", "expected", "got", "hint")
"""Attributes of `Invalid`, besides its code."""


class Picklable(Exception):
    """An error that can be copied and sent between processes, whatever arguments its class is created with."""

    def __reduce__(self) -> tuple[Any, ...]:
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class Invalid(Picklable):
    """A given value is invalid. Each package derives its errors from this class and from its own base class.

    Attributes
    ----------
    code : str
        Stable machine-readable name of the fault, e.g. ``"too_few_frames"``.
    field : str
        The invalid input, e.g. ``"tracks"``, ``"mesh.faces"`` or ``"options.seed"``.
    expected : str
        What was expected, in words.
    got : str
        What was given, in words.
    hint : str
        What the user can do about it, as a complete sentence.
    """

    def __init__(self, code: str, *, field: str, expected: str, got: str, hint: str) -> None:
        Exception.__init__(self, f"{field}: expected {expected}, got {got}. {hint}")  # siblings may need more arguments
        self.code = code
        self.field = field
        self.expected = expected
        self.got = got
        self.hint = hint


def members_of(error: BaseException) -> Mapping[str, object]:
    """Return the members that an error contributes to its problem document, without those that it does not have."""
    return {name: value for name in (*SIDES, "choices") if (value := getattr(error, name, None)) is not None}

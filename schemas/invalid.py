"""What every error about an invalid value states: code, field, what was expected, what was given, and what to do about it.

The members are those of a problem document. Only the standard library is imported, so the solver can use it too.
"""

from __future__ import annotations

from collections.abc import Mapping

SIDES = ("field", "expected", "got", "hint")
"""Attributes of every error of this kind, beside its code."""


class Invalid(Exception):
    """Something given is invalid. The rooms derive their own errors from it, together with their own base class.

    Attributes
    ----------
    code : str
        Stable machine-readable name of the fault, e.g. ``"too_few_frames"``.
    field : str
        What is at fault, e.g. ``"tracks"``, ``"mesh.faces"`` or ``"options.seed"``.
    expected, got : str
        What was expected and what was given, in words.
    hint : str
        What the user can do about it: a whole sentence.
    """

    def __init__(self, code: str, *, field: str, expected: str, got: str, hint: str) -> None:
        Exception.__init__(self, f"{field}: expected {expected}, got {got}. {hint}")  # a sibling class may ask for more
        self.code = code
        self.field = field
        self.expected = expected
        self.got = got
        self.hint = hint


def members_of(error: BaseException) -> Mapping[str, object]:
    """Return the members that an error contributes to its problem document; those that it does not have are left out."""
    return {name: value for name in (*SIDES, "choices") if (value := getattr(error, name, None)) is not None}

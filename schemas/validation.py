"""Descriptions of the values that pydantic expected, phrased to follow the word "expected"."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

_LENGTHS = {
    "too_short": ("at least", "min_length", "item"),
    "too_long": ("at most", "max_length", "item"),
    "string_too_short": ("at least", "min_length", "character"),
    "string_too_long": ("at most", "max_length", "character"),
}
"""Types of errors about a length: the words before the limit, its key in the error's context, and its unit."""

_BOUNDS = {
    "greater_than_equal": ("at least", "ge"),
    "greater_than": ("more than", "gt"),
    "less_than_equal": ("at most", "le"),
    "less_than": ("less than", "lt"),
}
"""Types of errors about a bound: the words before it, and its key in the error's context."""

_EXPLAINED = ("int_parsing", "int_from_float", "float_parsing", "bool_parsing")
"""Types of errors whose message continues, after a comma, with what was wrong."""


def alternatives(names: Iterable[str]) -> str:
    """Return a list of valid values in words, such as ``high, normal or low``."""
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def expectation(error: Mapping[str, Any]) -> str:
    """Describe what one of `ValidationError.errors()` expected, such as ``'l1', 'l2' or 'huber'`` or ``more than 0``."""
    if error["type"] == "missing":
        return "a value"
    if error["type"] == "json_invalid":
        return f"JSON ({error['ctx']['error']})"
    if error["type"] in _LENGTHS:
        words, limit, unit = _LENGTHS[error["type"]]
        count = int(error["ctx"][limit])
        return f"{words} {count:,} {unit}{'' if count == 1 else 's'}"
    if error["type"] in _BOUNDS:
        words, bound = _BOUNDS[error["type"]]
        return f"{words} {_number(error['ctx'][bound])}"
    if error["type"] == "extra_forbidden":
        return "no value, because the name is unknown"
    if error["type"] == "tuple_type":  # of JSON, which has no tuples
        return "a list in brackets"
    if error["type"] == "string_pattern_mismatch":
        return f"text that matches {error['ctx']['pattern']}"
    message = str(error["msg"])
    if error["type"] in _EXPLAINED:
        message = message.partition(",")[0]
    for introduction in ("Input should be ", "Value error, "):
        message = message.removeprefix(introduction)
    return message[:1].lower() + message[1:]


def _number(bound: object) -> str:
    return f"{bound:,}" if isinstance(bound, int) else f"{bound:g}" if isinstance(bound, float) else str(bound)

"""What is wrong with the options of a job: the same code and words for the service, the SDK and the command line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pliant.schemas.invalid import Invalid
from pliant.schemas.options import Options
from pliant.schemas.problems import ProblemCode
from pliant.schemas.suggestions import closest
from pliant.schemas.validation import expectation

LONGEST = 80
"""Characters of a value in a message; longer ones are cut."""


def option_fault(error: Mapping[str, Any]) -> Invalid:
    """Return (not raise) what one of `ValidationError.errors()` says about `Options`; the hint is empty or a suggestion."""
    where = [str(part) for part in error["loc"]]
    field = ".".join(["options", *where])
    if error["type"] != "extra_forbidden":
        return Invalid(
            ProblemCode.INVALID_OPTION, field=field, expected=expectation(error), got=shown(error.get("input")), hint=""
        )
    meant = closest(where[-1], Options.model_fields)
    return Invalid(
        ProblemCode.UNKNOWN_OPTION, field=field[:LONGEST], expected="the name of an option", got=f"the unknown name {shown(where[-1])}",
        hint="" if meant is None else f"Did you mean {meant}?",
    )  # fmt: skip


def shown(value: object) -> str:
    """Return a value's text, cut to `LONGEST` characters; bytes are shown as text."""
    text = repr(value.decode("utf-8", "backslashreplace") if isinstance(value, bytes) else value)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "…"

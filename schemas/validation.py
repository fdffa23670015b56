"""What pydantic expected of a value, in words that continue the word "expected"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def expectation(error: Mapping[str, Any]) -> str:
    """Return what one of `ValidationError.errors()` expected, such as ``'l1', 'l2' or 'huber'`` or ``greater than 0``."""
    if error["type"] == "missing":
        return "a value"
    message = str(error["msg"])
    for introduction in ("Input should be ", "Value error, "):
        message = message.removeprefix(introduction)
    return message[:1].lower() + message[1:]

"""Requests for further files and share links, checked before they are sent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pliant.client.errors import BadArgument
from pliant.schemas.outputs import OutputRequest
from pliant.schemas.shares import DAY, ShareRequest
from pliant.schemas.validation import expectation
from pydantic import ValidationError


def further(outputs: Iterable[str] | str, options: Mapping[str, Any]) -> OutputRequest:
    """Return a request for further files.

    Raises
    ------
    BadArgument
        An output or an option is unknown or invalid.
    """
    wanted = outputs if isinstance(outputs, str) else list(outputs)
    try:
        return OutputRequest.model_validate({"outputs": wanted, **options})
    except ValidationError as fault:
        first = fault.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise BadArgument(f"{field}: expected {expectation(first)}, got {first['input']!r}.") from fault


def sharing(days: float) -> ShareRequest:
    """Return a request for a share link.

    Raises
    ------
    BadArgument
        The lifetime is less than a minute or more than 366 days.
    """
    try:
        return ShareRequest(expires_in=round(days * DAY))
    except (ValidationError, OverflowError, ValueError) as fault:
        raise BadArgument(f"days: expected a minute (0.0007) to 366 days, got {days!r}.") from fault

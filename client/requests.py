"""Parts of requests that are checked before they are sent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pliant.client.errors import BadArgument
from pliant.schemas.job import LONGEST_KEY, Status
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
    except (OverflowError, ValueError, TypeError) as fault:
        raise BadArgument(f"days: expected a minute (0.0007) to 366 days, got {days!r}.") from fault


def key_header(idempotency_key: str) -> dict[str, str]:
    """Return the header with an idempotency key.

    Raises
    ------
    BadArgument
        The key is not a text that a header can hold.
    """
    key = idempotency_key
    if not isinstance(key, str) or not 1 <= len(key) <= LONGEST_KEY or not key.isprintable() or key != key.strip():
        raise BadArgument(
            f"idempotency_key: expected 1 to {LONGEST_KEY} printable characters without a space at either end, got {key!r:.80}. "
            "A random UUID is a good key."
        )
    return {"Idempotency-Key": key}


def status_names(statuses: Iterable[Status | str]) -> list[str]:
    """Return the names of some statuses, or of one.

    Raises
    ------
    BadArgument
        There is no such status.
    """
    try:
        return [Status(each).value for each in ([statuses] if isinstance(statuses, str) else statuses)]
    except ValueError as fault:
        raise BadArgument(f"statuses: {fault}. Choose from {', '.join(Status)}.") from fault

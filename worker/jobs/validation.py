"""What an id, a key, a cursor can look like: checked before anything is asked of a store."""

from __future__ import annotations

import re

from pliant.worker.errors import InvalidRequest

LARGEST_PAGE = 200
LONGEST_KEY = 255

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{2,63}")
_CURSOR = re.compile(r"[0-9]{14}:[A-Za-z0-9_-]{3,64}")
_EVENT = re.compile(r"[0-9]{1,20}-[0-9]{1,20}")


def is_id(text: str) -> bool:
    """Tell whether a job could have this id."""
    return _ID.fullmatch(text) is not None


def check_id(id: str) -> None:
    """Refuse an id that cannot be one; every refusal here is an `InvalidRequest`."""
    if not is_id(id):
        raise InvalidRequest(
            "invalid_id", field="id", expected="3–64 letters, digits, underscores or dashes", got=repr(id)[:80],
            hint="Choose another id or leave it out.",
        )  # fmt: skip


def check_key(idempotency_key: str) -> None:
    """Refuse an idempotency key that is empty or too long."""
    if not 1 <= len(idempotency_key) <= LONGEST_KEY:
        raise InvalidRequest(
            "invalid_idempotency_key", field="Idempotency-Key", expected=f"1–{LONGEST_KEY} characters",
            got=f"{len(idempotency_key)}", hint="A random UUID is a good key.",
        )  # fmt: skip


def check_page(cursor: str | None, limit: int) -> None:
    """Refuse a cursor that we did not give, and a limit out of range."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidRequest(
            "invalid_limit", field="limit", expected=f"1–{LARGEST_PAGE}", got=str(limit), hint="Ask for less at once."
        )
    if cursor is not None and not _CURSOR.fullmatch(cursor):
        raise InvalidRequest(
            "invalid_cursor", field="cursor", expected="`next` of an earlier page", got=repr(cursor)[:80],
            hint="Start again without a cursor.",
        )  # fmt: skip


def check_event_id(after: str) -> None:
    """Refuse what is not the id of an event."""
    if not _EVENT.fullmatch(after) or any(int(part) >= 2**64 for part in after.split("-")):
        raise InvalidRequest(
            "invalid_event_id", field="Last-Event-ID", expected="the id of an event", got=repr(after)[:80],
            hint="Leave it out to get all events that are kept.",
        )  # fmt: skip

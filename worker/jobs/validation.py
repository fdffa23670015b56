"""Validation of keys, cursors and event ids, before a store is queried."""

from __future__ import annotations

import re

from pliant.schemas.job import LARGEST_PAGE, LONGEST_KEY
from pliant.worker.errors import InvalidRequest

_CURSOR = re.compile(r"[0-9]{14}:[A-Za-z0-9_-]{3,64}")
_EVENT = re.compile(r"[0-9]{1,20}-[0-9]{1,20}")
_LARGEST_EVENT = 2**64 - 1
"""Maximum of each part of the id of a Redis stream entry."""


def check_key(idempotency_key: str) -> None:
    """Check the length of an idempotency key."""
    if not 1 <= len(idempotency_key) <= LONGEST_KEY:
        raise InvalidRequest(
            "invalid_idempotency_key", field="Idempotency-Key", expected=f"1–{LONGEST_KEY} characters",
            got=f"{len(idempotency_key)}", hint="A random UUID is a good key.",
        )  # fmt: skip


def check_page(cursor: str | None, limit: int) -> None:
    """Check that a cursor is one that `Jobs.page` returned, and that a limit is in range."""
    if not 1 <= limit <= LARGEST_PAGE:
        raise InvalidRequest(
            "invalid_limit", field="limit", expected=f"1–{LARGEST_PAGE}", got=str(limit),
            hint="Request a page of that many; `next` continues with the following one.",
        )  # fmt: skip
    if cursor is not None and not _CURSOR.fullmatch(cursor):
        raise InvalidRequest(
            "invalid_cursor", field="cursor", expected="`next` of an earlier page", got=repr(cursor)[:80],
            hint="Start again without a cursor.",
        )  # fmt: skip


def check_event_id(after: str) -> None:
    """Check that a text is the id of an event: two 64-bit numbers joined by a dash."""
    parts = [int(part) for part in after.split("-")] if _EVENT.fullmatch(after) else []
    if not parts or max(parts) > _LARGEST_EVENT or min(parts) == _LARGEST_EVENT:  # nothing can follow the largest id
        raise InvalidRequest(
            "invalid_event_id", field="Last-Event-ID", expected="the id of an event", got=repr(after)[:80],
            hint="Omit it to get all events that are kept.",
        )  # fmt: skip

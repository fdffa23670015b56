"""Ids of jobs and uploads, which clients may choose, and of attempts."""

from __future__ import annotations

import re
import secrets

from pliant.worker.errors import InvalidRequest

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{2,63}")


def is_id(text: str) -> bool:
    """Return whether a job or an upload may have this id."""
    return _ID.fullmatch(text) is not None


def check_id(id: str) -> None:
    """Validate an id chosen by a client.

    Raises
    ------
    InvalidRequest
        Code invalid_id.
    """
    if not is_id(id):
        raise InvalidRequest(
            "invalid_id", field="id", expected="3–64 letters, digits, underscores or dashes", got=repr(id)[:80],
            hint="Choose another id or omit it.",
        )  # fmt: skip


def new_job_id() -> str:
    """Return a new job id."""
    return secrets.token_hex(10)


def new_attempt_id(job_id: str) -> str:
    """Return a new attempt id; RQ allows letters, digits, underscores and dashes."""
    return f"{job_id}-{secrets.token_hex(6)}"

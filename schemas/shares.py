"""The wire contract of share links: temporary, read-only access to one job's results."""

from __future__ import annotations

from datetime import datetime

from pliant.schemas.job import Record
from pydantic import BaseModel, ConfigDict, Field

DAY = 24 * 3600
SHARE_PREFIX = "share."
"""Prefix of a share link's token, which distinguishes it from other bearer tokens."""


class ShareRequest(BaseModel):
    """Request for a share link."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    expires_in: int = Field(default=7 * DAY, ge=60, le=366 * DAY, description="Seconds until the link expires.")


class Share(Record):
    """A share link of a job."""

    id: str = Field(description="Names the link when it is revoked.")
    created_at: datetime = Field(description="When the link was created.")
    expires_at: datetime = Field(description="When it stops working.")
    token: str | None = Field(
        default=None,
        description="Bearer token that reads the job and its files, and nothing else. Only the answer that creates the link has it.",
    )
    path: str | None = Field(
        default=None, description="Address of the page that shows the result, relative to the service; holds the token."
    )

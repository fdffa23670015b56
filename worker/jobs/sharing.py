"""Share links: a secret that reads one job's results until it expires or is revoked.

Only digests of the secrets are stored, in the job's record, so they are deleted with the job.
"""

from __future__ import annotations

import hmac
import secrets
from datetime import datetime, timedelta

from pliant.schemas.job import Status
from pliant.schemas.shares import SHARE_PREFIX, Share, ShareRequest
from pliant.worker.errors import NotAllowedNow, TooManyShares, UnknownJob, UnknownShare
from pliant.worker.ids import is_id
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Records, Stored, StoredShare
from pliant.worker.tokens import digest_of

MOST_SHARES = 20
"""Maximum number of valid links per job."""

LONGEST_TOKEN = 200


def create_share(jobs: Jobs, id: str, request: ShareRequest) -> Share:
    """Create a share link for a job and return it with its token.

    Raises
    ------
    NotAllowedNow
        The job has no result.
    TooManyShares
        The job has `MOST_SHARES` valid links.
    UnknownJob
        There is no such job.
    """
    jobs.stored(id)
    secret, now = secrets.token_urlsafe(24), jobs.clock()
    made = StoredShare(
        id=secrets.token_hex(4), digest=digest_of(secret), created_at=now,
        expires_at=now + timedelta(seconds=request.expires_in),
    )  # fmt: skip

    def change(stored: Stored) -> Stored:
        if stored.job.status is not Status.SUCCEEDED:
            hint = "It has no result." if stored.job.status.final else "Wait until it has succeeded."
            raise NotAllowedNow(id, stored.job.status, wanted="shared", hint=hint)
        valid = _valid(stored, now)
        if len(valid) >= MOST_SHARES:
            raise TooManyShares(id, MOST_SHARES)
        return stored.model_copy(update={"shares": (*valid, made)})

    jobs.records.update(id, change)
    token = f"{SHARE_PREFIX}{id}.{secret}"
    return _shown(made).model_copy(update={"token": token, "path": f"#share={token}"})


def list_shares(jobs: Jobs, id: str) -> list[Share]:
    """Return the valid links of a job, without their tokens, oldest first."""
    return [_shown(each) for each in _valid(jobs.stored(id), jobs.clock())]


def revoke_share(jobs: Jobs, id: str, share: str) -> None:
    """Revoke a link, effective immediately.

    Raises
    ------
    UnknownShare
        The job has no such link.
    """
    jobs.stored(id)

    def change(stored: Stored) -> Stored:
        rest = tuple(each for each in stored.shares if each.id != share)
        if len(rest) == len(stored.shares):
            raise UnknownShare(id, share)
        return stored.model_copy(update={"shares": rest})

    jobs.records.update(id, change)


def recognise_share(records: Records, token: str) -> tuple[Stored, StoredShare] | None:
    """Return the job and the link, expired or not, of a link's token; None if there is no such link."""
    id, dot, secret = token.removeprefix(SHARE_PREFIX).rpartition(".")
    if len(token) > LONGEST_TOKEN or not token.startswith(SHARE_PREFIX) or not dot or not is_id(id):
        return None
    try:
        stored = records.get(id)
    except UnknownJob:
        return None
    digest = digest_of(secret)
    for each in stored.shares:
        if hmac.compare_digest(each.digest, digest):
            return stored, each
    return None


def _valid(stored: Stored, now: datetime) -> tuple[StoredShare, ...]:
    return tuple(each for each in stored.shares if now < each.expires_at)


def _shown(share: StoredShare) -> Share:
    return Share(id=share.id, created_at=share.created_at, expires_at=share.expires_at)

"""Requests through share links, which can read one job and its files, and nothing else."""

from __future__ import annotations

import re

from anyio import to_thread
from fastapi.responses import Response
from pliant.schemas.problems import ProblemCode
from pliant.schemas.shares import SHARE_PREFIX
from pliant.service.problems import answer, of_error
from pliant.worker.errors import StoreUnavailable
from pliant.worker.jobs.sharing import recognise_share
from pliant.worker.records import Records, utc_now
from starlette.datastructures import Headers
from starlette.types import Scope

_READABLE = re.compile(r"/v1/jobs/(?P<id>[^/]+)(/events|/shares|/artifacts(/[^/]+)?)?")


def bearer_of(scope: Scope) -> str | None:
    """Return the bearer token of a request; None if it has none, or several."""
    given = Headers(scope=scope).getlist("authorization")
    scheme, _, text = given[0].partition(" ") if len(given) == 1 else ("", "", "")
    return text.strip() if scheme.lower() == "bearer" else None


def share_of(scope: Scope) -> str | None:
    """Return the share link's token of a request, or None if it has none."""
    token = bearer_of(scope)
    return token if token is not None and token.startswith(SHARE_PREFIX) else None


async def authorize_share(scope: Scope, token: str, records: Records) -> Response | None:
    """Return the refusal of a request that its link does not allow; else set `pliant.owner` and `pliant.share` in the scope."""
    now = utc_now()
    try:
        found = await to_thread.run_sync(recognise_share, records, token)
    except StoreUnavailable as error:
        return of_error(error)
    if found is None:
        detail = "This share link is not valid: it was revoked, or its job was deleted. Ask its sender for a new one."
        return _refused(ProblemCode.INVALID_SHARE, detail)
    stored, share = found
    if now >= share.expires_at:
        detail = "This share link has expired. Ask its sender for a new one."
        return _refused(ProblemCode.EXPIRED_SHARE, detail, got=share.expires_at.isoformat())
    wanted = _READABLE.fullmatch(scope["path"])
    if scope["method"] not in ("GET", "HEAD") or wanted is None or wanted["id"] != stored.job.id:
        detail = "A share link reads the results of its own job and changes nothing. Use a token for anything else."
        return answer(ProblemCode.BEYOND_SHARE, detail=detail, field="Authorization")
    scope["pliant.owner"], scope["pliant.share"] = stored.owner, share.id
    return None


def _refused(code: ProblemCode, detail: str, *, got: str | None = None) -> Response:
    challenge = 'Bearer realm="pliant", error="invalid_token"'
    return answer(code, detail=detail, headers={"WWW-Authenticate": challenge}, field="Authorization", got=got)

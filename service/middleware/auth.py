"""Authentication and authorization, from the headers alone, before a byte of the body is read and before routing.

Every path needs a token except those that `is_public` lists, so a new route is protected by default.
"""

from __future__ import annotations

import time

from anyio import to_thread
from fastapi.responses import Response
from pliant.schemas.problems import ProblemCode
from pliant.service.middleware.share_links import authorize_share, bearer_of, share_of
from pliant.service.problems import answer, of_error
from pliant.service.settings import ServiceSettings
from pliant.worker.errors import StoreUnavailable, UnknownToken
from pliant.worker.records import Records, utc_now
from pliant.worker.tokens import Scope, Token, Tokens
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

PUBLIC = frozenset({"/", "/guide", "/docs", "/openapi.json", "/healthz", "/readyz", "/errors"})
"""Paths that need no token: the page, which must load to ask for one, the API's description and reference, and the health checks."""
PUBLIC_FOLDERS = ("/page/", "/errors/")
"""The files of the page, and the explanations of error codes."""

ANY_SCOPE = ("/v1/options", "/v1/limits", "/v1/examples")
"""Paths that every valid token may read: nothing there belongs to an owner."""

_READS = frozenset({"GET", "HEAD", "OPTIONS"})


def needed(method: str, path: str) -> Scope | None:
    """Return the scope that a request needs; None if any valid token will do.

    Reading the state of an upload needs `submit`, so that a token with only this scope can resume an upload.
    """
    if path == "/metrics":
        return Scope.ADMIN
    if method not in _READS or path.startswith("/v1/uploads/"):
        return Scope.SUBMIT
    if any(path == each or path.startswith(f"{each}/") for each in ANY_SCOPE):
        return None
    return Scope.READ


def is_public(path: str) -> bool:
    """Return True if a path needs no token."""
    return path in PUBLIC or path.startswith(PUBLIC_FOLDERS)


class StillValid:
    """Checks again whether a request's token is valid, for long-lived responses."""

    def __init__(self, tokens: Tokens, token: Token, *, every: float) -> None:
        self._tokens = tokens
        self._token = token
        self._every = every
        self._checked = time.monotonic()

    async def __call__(self) -> bool:
        """Return True if the token is valid, checked at most once per period; it counts as valid if the store does not answer."""
        now = time.monotonic()
        if now < self._checked + self._every:
            return True
        self._checked = now
        try:
            token = await to_thread.run_sync(self._tokens.get, self._token.id)
        except UnknownToken:
            return False
        except StoreUnavailable:
            return True
        return not token.expired(utc_now())


class Authentication:
    """ASGI middleware that requires a valid token and sets `pliant.token` and `pliant.owner` in the request's scope.

    The owner is None if all jobs are visible: with tokens off, and with the scope `admin`. The token of a share link is checked
    even with tokens off.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings, tokens: Tokens, records: Records) -> None:
        self._app = app
        self._records = records
        self._on = settings.asks_for_tokens
        self._tokens = tokens
        self._recheck = settings.heartbeat_seconds

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Pass on authorized requests and refuse others."""
        if scope["type"] != "http" or is_public(scope["path"]):
            await self._app(scope, receive, send)
            return
        share = share_of(scope)
        if share is not None:
            refusal = await authorize_share(scope, share, self._records)
            await (self._app if refusal is None else refusal)(scope, receive, send)
            return
        if not self._on:
            await self._app(scope, receive, send)
            return
        try:
            found = await self._authorize(scope)
        except StoreUnavailable as error:
            found = of_error(error)
        if isinstance(found, Response):
            await found(scope, receive, send)
            return
        owner = None if found.sees_all else found.owner
        scope["pliant.owner"] = owner
        scope["pliant.still_valid"] = StillValid(self._tokens, found, every=self._recheck)
        await self._app(scope, receive, send)

    async def _authorize(self, scope: AsgiScope) -> Token | Response:
        """Return the token of a request, or the answer that refuses it."""
        text = bearer_of(scope)
        if text is None:
            detail = "This service requires a token. Send it as `Authorization: Bearer …`."
            return _unauthorized(ProblemCode.UNAUTHORIZED, detail)
        token = await to_thread.run_sync(self._tokens.recognise, text)
        if token is None:
            detail = "The token is not known; it may have been revoked. Ask the operator for a new one."
            return _unauthorized(ProblemCode.INVALID_TOKEN, detail)
        scope["pliant.token"] = token  # the access log names the token of a refused request, too
        if token.expired(utc_now()):
            detail = "The token has expired. Ask the operator for a new one."
            return _unauthorized(ProblemCode.EXPIRED_TOKEN, detail)
        wanted = needed(scope["method"], scope["path"])
        if wanted is not None and not token.may(wanted):
            has = ", ".join(token.scopes)
            detail = f"This needs a token with the scope {wanted.value}; yours has: {has}. Use another token."
            challenge = f'Bearer realm="pliant", error="insufficient_scope", scope="{wanted.value}"'
            return answer(
                ProblemCode.INSUFFICIENT_SCOPE,
                detail=detail,
                headers={"WWW-Authenticate": challenge},
                field="Authorization",
                expected=wanted,
                got=has,
            )
        return token


def _unauthorized(code: ProblemCode, detail: str) -> Response:
    """Return the 401 response; its challenge distinguishes a missing token from an invalid one (RFC 6750, section 3)."""
    challenge = 'Bearer realm="pliant"'
    if code is not ProblemCode.UNAUTHORIZED:
        challenge += ', error="invalid_token"'
    return answer(code, detail=detail, headers={"WWW-Authenticate": challenge}, field="Authorization")

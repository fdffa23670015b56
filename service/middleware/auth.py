"""Who asks, and whether he may: decided from the headers, before a byte of the body is read and before any routing.

Pure ASGI. Everything needs a token but what `PUBLIC` lists, so a route that somebody adds is protected from its first day.
"""

from __future__ import annotations

import time

from anyio import to_thread
from fastapi.responses import Response
from pliant.service.problems import answer, from_error, problem
from pliant.service.settings import ServiceSettings
from pliant.worker.errors import StoreUnavailable, UnknownToken
from pliant.worker.records import utc_now
from pliant.worker.tokens import Scope, Token, Tokens
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Send
from starlette.types import Scope as AsgiScope

PUBLIC = frozenset({"/", "/docs", "/openapi.json", "/healthz", "/readyz"})
"""What is answered without a token: the page, which must load to ask for one, the API's description, and the two signs of health."""
PUBLIC_FOLDER = "/page/"
"""The page's own files, answered from a table of what was built."""

ANY_SCOPE = ("/v1/options", "/v1/limits", "/v1/examples")
"""What every valid token may read: nothing there belongs to anybody."""

_READS = frozenset({"GET", "HEAD", "OPTIONS"})


def needed(method: str, path: str) -> Scope | None:
    """Return the scope that a request needs; None if any valid token will do."""
    if path == "/metrics":
        return Scope.ADMIN
    if method not in _READS:
        return Scope.SUBMIT
    if any(path == each or path.startswith(f"{each}/") for each in ANY_SCOPE):
        return None
    return Scope.READ


def is_public(path: str) -> bool:
    """Tell whether an address is answered without a token."""
    return path in PUBLIC or path.startswith(PUBLIC_FOLDER)


class StillGood:
    """Tells of a token that was good when the request came whether it still is; for answers that last."""

    def __init__(self, tokens: Tokens, token: Token, *, every: float) -> None:
        self._tokens = tokens
        self._token = token
        self._every = every
        self._asked = time.monotonic()

    async def __call__(self) -> bool:
        """Ask the store, at most every so many seconds; a store that is away changes nothing."""
        now = time.monotonic()
        if now < self._asked + self._every:
            return True
        self._asked = now
        try:
            token = await to_thread.run_sync(self._tokens.get, self._token.id)
        except UnknownToken:
            return False
        except StoreUnavailable:
            return True
        return not token.expired(utc_now())


class Authentication:
    """ASGI middleware that asks for a token and hands on whose request it is, as `pliant.token` and `pliant.owner`.

    The owner is None where everybody's jobs may be seen: with tokens off, and with the scope `admin`.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings, tokens: Tokens) -> None:
        self._app = app
        self._on = settings.asks_for_tokens
        self._tokens = tokens
        self._recheck = settings.heartbeat_seconds

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        """Pass on a request that may be, refuse the others."""
        if scope["type"] != "http" or not self._on or is_public(scope["path"]):
            await self._app(scope, receive, send)
            return
        try:
            found = await self._judged(scope)
        except StoreUnavailable as error:
            found = answer(from_error(error, 503), headers={"Retry-After": "2"})
        if isinstance(found, Response):
            await found(scope, receive, send)
            return
        owner = None if found.sees_all else found.owner
        scope["pliant.token"], scope["pliant.owner"] = found, owner
        scope["pliant.still_good"] = StillGood(self._tokens, found, every=self._recheck)
        await self._app(scope, receive, send)

    async def _judged(self, scope: AsgiScope) -> Token | Response:
        """Return the token of a request, or the answer that refuses it."""
        given = Headers(scope=scope).getlist("authorization")
        scheme, _, text = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        if scheme.lower() != "bearer":
            return _unauthorised("unauthorised", "This service asks for a token. Send it as `Authorization: Bearer …`.")
        token = await to_thread.run_sync(self._tokens.recognise, text.strip())
        if token is None:
            return _unauthorised(
                "invalid_token",
                "The token is not known here; it may have been revoked. Ask whoever runs the service for one.",
            )
        if token.expired(utc_now()):
            return _unauthorised(
                "expired_token", "The token's time is over. Ask whoever runs the service for a new one."
            )
        wanted = needed(scope["method"], scope["path"])
        if wanted is not None and not token.may(wanted):
            has = ", ".join(token.scopes)
            detail = f"This needs a token with the scope {wanted.value}, and yours has: {has}. Use another token."
            challenge = f'Bearer realm="pliant", error="insufficient_scope", scope="{wanted.value}"'
            refusal = problem(403, "insufficient_scope", detail=detail, field="Authorization", expected=wanted, got=has)
            return answer(refusal, headers={"WWW-Authenticate": challenge})
        return token


def _unauthorised(code: str, detail: str) -> Response:
    """Return the answer 401; a token that was sent and is no good is told from one that was not sent (RFC 6750, section 3)."""
    challenge = 'Bearer realm="pliant"'
    if code != "unauthorised":
        challenge += ', error="invalid_token"'
    refusal = problem(401, code, detail=detail, field="Authorization")
    return answer(refusal, headers={"WWW-Authenticate": challenge})

"""Rate limits per token, or per address where tokens are off, counted in this process.

The counts are in memory, because the store writes every change to disk before it answers, which would cost more than most
requests. N API processes therefore allow N times as many requests.
"""

from __future__ import annotations

import ipaddress
import math
import time
from collections.abc import Callable

from pliant.schemas.problems import ProblemCode
from pliant.service.problems import answer
from pliant.service.settings import ServiceSettings
from pliant.worker.tokens import Token
from starlette.types import ASGIApp, Receive, Scope, Send

WINDOW = 60.0
"""Burst size: the requests allowed within this many seconds may all arrive at once."""

MOST_CLIENTS = 20_000
"""Maximum number of clients in memory; above it, those with the most requests left are dropped first."""

UNCOUNTED = frozenset({"/healthz", "/readyz"})


class Rates:
    """The generic cell rate algorithm (ITU-T I.371), with one theoretical arrival time per client."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._paid_off: dict[str, float] = {}

    def take(self, who: str, per_minute: int) -> float:
        """Count a client's request and return 0 if it is allowed; otherwise return the seconds to wait without counting it."""
        now, price = self._clock(), WINDOW / per_minute
        due = max(self._paid_off.get(who, now), now) + price
        if due - now > WINDOW * (1 + 1e-9):
            return due - now - WINDOW
        self._paid_off[who] = due
        if len(self._paid_off) > MOST_CLIENTS:
            self._forget(now)
        return 0.0

    def _forget(self, now: float) -> None:
        kept = sorted(((due, who) for who, due in self._paid_off.items() if due > now), reverse=True)[
            : MOST_CLIENTS // 2
        ]
        self._paid_off = {who: due for due, who in kept}


class RateLimit:
    """ASGI middleware that responds with 429 above the limit. It runs after `Authentication`, which identifies the client."""

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._app = app
        self._settings = settings
        self._rates = Rates()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on a request within the limit."""
        if scope["type"] != "http" or scope["path"] in UNCOUNTED:
            await self._app(scope, receive, send)
            return
        token: Token | None = scope.get("pliant.token")
        allowed = self._settings.rate_of(token.requests_per_minute if token is not None else None)
        wait = self._rates.take(_client(scope, token), allowed) if allowed > 0 else 0.0
        if wait == 0.0:
            await self._app(scope, receive, send)
            return
        seconds = max(1, math.ceil(wait))
        detail = f"More than {allowed} requests in a minute. Try again in {seconds} s; to wait for jobs use `Prefer: wait` or events."
        refused = answer(
            ProblemCode.TOO_MANY_REQUESTS,
            detail=detail,
            headers={"Retry-After": str(seconds)},
            expected=f"at most {allowed} a minute",
            got="more",
        )
        await refused(scope, receive, send)


def _client(scope: Scope, token: Token | None) -> str:
    """Return the token's id, or the client's address; for IPv6 its /64 network, since one client has many addresses."""
    if token is not None:
        return token.id
    host = (scope.get("client") or ("", 0))[0]
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv4Address):
        return host
    mapped = address.ipv4_mapped  # all such addresses are in one /64 network
    return str(mapped or ipaddress.ip_network((address, 64), strict=False))

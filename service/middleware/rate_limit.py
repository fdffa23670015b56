"""How often one client may ask: a count per token, or per address where tokens are off, kept in this process.

In memory and not in the store: the store writes every change to disk before it answers, which is right for a job and far too
much for each look at one. So several API processes allow several times as much.
"""

from __future__ import annotations

import ipaddress
import math
import time
from collections.abc import Callable

from pliant.service.problems import answer, problem
from pliant.service.settings import ServiceSettings
from pliant.worker.tokens import Token
from starlette.types import ASGIApp, Receive, Scope, Send

WINDOW = 60.0
"""Seconds in which the allowed number may be used up all at once."""

MOST_CLIENTS = 20_000
"""Clients remembered; beyond that, those who have the most left are forgotten first."""

UNCOUNTED = frozenset({"/healthz", "/readyz"})


class Rates:
    """The generic cell rate algorithm (ITU-T I.371): of each client, only when all it asked so far is paid off."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._paid_off: dict[str, float] = {}

    def take(self, who: str, per_minute: int) -> float:
        """Count a request; return 0 if it may be, else after how many seconds one may (it is not counted then).

        Parameters
        ----------
        who : str
            The client.
        per_minute : int
            Requests allowed in a minute, at least 1.
        """
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
    """ASGI middleware that answers 429 to who asks too often. Stands behind `Authentication`, which says who asks."""

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._app = app
        self._settings = settings
        self._rates = Rates()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on a request that comes in time."""
        if scope["type"] != "http" or scope["path"] in UNCOUNTED:
            await self._app(scope, receive, send)
            return
        token: Token | None = scope.get("pliant.token")
        allowed = self._settings.rate_of(token.requests_per_minute if token is not None else None)
        wait = self._rates.take(_who(scope, token), allowed) if allowed > 0 else 0.0
        if wait == 0.0:
            await self._app(scope, receive, send)
            return
        seconds = max(1, math.ceil(wait))
        detail = f"More than {allowed} requests in a minute. Ask again in {seconds} s, or wait for jobs with `Prefer: wait` or events."
        said = problem(429, "too_many_requests", detail=detail, expected=f"at most {allowed} a minute", got="more")
        await answer(said, headers={"Retry-After": str(seconds)})(scope, receive, send)


def _who(scope: Scope, token: Token | None) -> str:
    """Return the token's id, or the address a request comes from; of IPv6 the network, of which one client has many addresses."""
    if token is not None:
        return token.id
    host = (scope.get("client") or ("", 0))[0]
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    return str(ipaddress.ip_network((address, 64), strict=False)) if address.version == 6 else host

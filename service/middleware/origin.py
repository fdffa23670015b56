"""What is checked of every request before anything else, and what is said with every answer.

Both are pure ASGI: they act on the headers, before a byte of the body is read.
"""

from __future__ import annotations

from fastapi.responses import Response
from pliant.service.problems import answer, problem
from pliant.service.settings import ServiceSettings
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_LOOPBACK_HOSTS = frozenset({"localhost", "127.0.0.1", "[::1]"})
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
EVERY_ANSWER = {
    # An answer of the API is no page and loads nothing; the page itself says what it needs (`pliant.service.page`).
    "Content-Security-Policy": "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}


class SecurityHeaders:
    """ASGI middleware that adds the headers by which a browser is told to be careful."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and add the headers to its answer; one that a route has set stays."""

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in EVERY_ANSWER.items():
                    headers.setdefault(name, value)
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        await self._app(scope, receive, with_headers if scope["type"] == "http" else send)


class OriginGuard:
    """ASGI middleware against pages of other sites: strange Host headers, and writes that come from elsewhere.

    A service on the loopback address without tokens is reachable by every page the user visits: through a name that
    resolves to 127.0.0.1 (DNS rebinding), and by forms, which browsers send across sites without asking.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._app = app
        self._hosts = frozenset(settings.allowed_hosts) or (_LOOPBACK_HOSTS if settings.loopback else frozenset())
        self._origins = frozenset(settings.cors_origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a strange host or a write from another site; pass on the rest."""
        refused = self._refusal(scope) if scope["type"] == "http" else None
        await (self._app if refused is None else refused)(scope, receive, send)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if self._hosts and _without_port(host) not in self._hosts:
            detail = f"This service does not answer for the host {host[:80]!r}. Whoever runs it adds it to PLIANT_ALLOWED_HOSTS."
            return answer(problem(421, "unknown_host", detail=detail, field="Host", got=host[:80]))
        if scope["method"] in _SAFE:
            return None
        origin = headers.get("origin")
        from_elsewhere = headers.get("sec-fetch-site") in ("cross-site", "same-site")
        if origin is not None and origin not in self._origins:
            from_elsewhere = from_elsewhere or origin.partition("://")[2] != host
        if from_elsewhere and origin not in self._origins:
            detail = "A page of another site may not write here. Whoever runs the service adds its origin to PLIANT_CORS_ORIGINS."
            return answer(problem(403, "cross_site_request", detail=detail, field="Origin", got=(origin or "")[:80]))
        return None


def _without_port(host: str) -> str:
    """Return a Host header's name, in lower case, an IPv6 address with its brackets."""
    if host.startswith("["):
        return host.partition("]")[0].lower() + "]"
    return host.partition(":")[0].lower()

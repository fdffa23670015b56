"""The origin check refuses unknown Host headers, and writes that a browser sends for a page of another site.

It uses only the headers, before a byte of the body is read.
"""

from __future__ import annotations

from fastapi.responses import Response
from pliant.schemas.problems import ProblemCode
from pliant.service.problems import answer
from pliant.service.settings import ServiceSettings
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

_LOOPBACK_HOSTS = frozenset({"localhost", "127.0.0.1", "[::1]"})
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
FOR_MACHINES = frozenset({"/healthz", "/readyz", "/metrics"})
"""Paths for probes and monitoring, which address a process by an IP address that nobody can list beforehand."""


class OriginCheck:
    """ASGI middleware against requests from pages of other sites.

    A service on the loopback address without tokens is reachable from every page the user visits: through a name that
    resolves to 127.0.0.1 (DNS rebinding), and through forms, which browsers send across sites without a preflight.
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._app = app
        self._hosts = frozenset(map(_without_port, settings.allowed_hosts)) or (
            _LOOPBACK_HOSTS | {settings.host.lower()} if settings.loopback else frozenset()
        )
        self._origins = frozenset(settings.cors_origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse an unknown host or a write from another site; pass on the rest."""
        refused = self._refusal(scope) if scope["type"] == "http" else None
        await (self._app if refused is None else refused)(scope, receive, send)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        listed = scope["path"] in FOR_MACHINES or not self._hosts or _without_port(host) in self._hosts
        if not listed:
            detail = f"This service does not answer for the host {host[:80]!r}. The operator can add it to PLIANT_ALLOWED_HOSTS."
            return answer(ProblemCode.UNKNOWN_HOST, detail=detail, field="Host", got=host[:80])
        if scope["method"] in _SAFE:
            return None
        origin = headers.get("origin")
        if origin in self._origins:
            return None
        from_elsewhere = headers.get("sec-fetch-site") in ("cross-site", "same-site")
        if from_elsewhere or (origin is not None and origin.partition("://")[2] != host):
            detail = (
                "A page of another site may not write here. The operator can add its origin to PLIANT_CORS_ORIGINS."
            )
            return answer(
                ProblemCode.CROSS_SITE_REQUEST,
                detail=detail,
                field="Origin",
                expected=host[:80],
                got=(origin or "")[:80],
            )
        return None


def _without_port(host: str) -> str:
    """Return the host of a Host header in lower case, IPv6 addresses with their brackets."""
    if host.startswith("["):
        return host.partition("]")[0].lower() + "]"
    return host.partition(":")[0].lower()

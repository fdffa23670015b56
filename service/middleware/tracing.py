"""A span for each request, which continues the trace of the request's `traceparent` header."""

from __future__ import annotations

from pliant.service.middleware.origin import FOR_MACHINES
from pliant.worker import tracing
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send


class Tracing:
    """ASGI middleware that records a span per request, except of monitoring; with tracing off it only passes requests on."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on within its span."""
        if scope["type"] != "http" or scope["path"] in FOR_MACHINES:
            await self._app(scope, receive, send)
            return
        with tracing.span(scope["method"], parent=Headers(scope=scope).get("traceparent")) as current:

            async def watched(message: Message) -> None:
                if current is not None and message["type"] == "http.response.start":
                    route = getattr(scope.get("route"), "path", None)
                    if route is not None:
                        current.update_name(f"{scope['method']} {route}")
                    current.set_attribute("http.response.status_code", message["status"])
                await send(message)

            await self._app(scope, receive, watched)

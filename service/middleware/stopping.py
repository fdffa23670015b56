"""Answer requests that are still running when the service must end; the server would answer them with a bare status 500."""

from __future__ import annotations

import asyncio

from pliant.schemas.problems import ProblemCode
from pliant.service.problems import answer
from starlette.types import ASGIApp, Message, Receive, Scope, Send

AGAIN = 5
"""Seconds after which to send such a request again: about as long as a restart takes."""


class Stopping:
    """ASGI middleware: a request that is cancelled before its response has begun is answered with 503."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on. The server cancels it once the time for running requests is over."""
        began = False

        async def watched_send(message: Message) -> None:
            nonlocal began
            began = began or message["type"] == "http.response.start"
            await send(message)

        try:
            await self._app(scope, receive, watched_send)
        except asyncio.CancelledError:
            if began or scope["type"] != "http":
                raise
            detail = f"The service is stopping and has dropped this request. Send it again in {AGAIN} s."
            refused = answer(ProblemCode.NOT_READY, detail=detail, headers={"Retry-After": str(AGAIN)})
            await refused(scope, receive, send)

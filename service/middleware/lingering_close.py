"""Lingering close: refuse a request whose body is still arriving, so that the client can read the response.

If the connection is closed immediately, the kernel resets it while the client is still sending, and the reset discards the
response on the client's side. Therefore the response is sent with `Connection: close`, the rest of the body is read and
discarded for a bounded time, and only then is the connection closed.
"""

from __future__ import annotations

import asyncio

from starlette.types import ASGIApp, Message, Receive, Scope, Send

LINGER_SECONDS = 2.0
LINGER_BYTES = 16 * 2**20


class LingeringClose:
    """ASGI middleware: if the application responds before it has read the whole body, drain part of it, then close."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, watching how far its body was read."""
        if scope["type"] != "http" or not _has_body(scope):
            await self._app(scope, receive, send)
            return
        exhausted = False
        early = False

        async def watched_receive() -> Message:
            nonlocal exhausted
            message = await receive()
            exhausted = exhausted or message["type"] == "http.disconnect" or not message.get("more_body", False)
            return message

        async def watched_send(message: Message) -> None:
            nonlocal early
            if message["type"] == "http.response.start" and not exhausted:
                early = True
                message = {**message, "headers": [*message.get("headers", ()), (b"connection", b"close")]}
            elif message["type"] == "http.response.body" and early and not message.get("more_body", False):
                await send({**message, "more_body": True})
                await _drain(receive)
                message = {"type": "http.response.body", "body": b""}
            await send(message)

        await self._app(scope, watched_receive, watched_send)


def _has_body(scope: Scope) -> bool:
    headers = dict(scope["headers"])
    return b"transfer-encoding" in headers or headers.get(b"content-length", b"0") != b"0"


async def _drain(receive: Receive) -> None:
    """Read and discard the body until it ends or a limit on time or bytes is reached."""
    dropped = 0
    try:
        async with asyncio.timeout(LINGER_SECONDS):
            while dropped < LINGER_BYTES:
                message = await receive()
                dropped += len(message.get("body", b""))
                if message["type"] == "http.disconnect" or not message.get("more_body", False):
                    return
    except TimeoutError:
        return

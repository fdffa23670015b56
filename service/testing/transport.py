"""An httpx transport that calls an ASGI application in this process, for both kinds of client.

`httpx.ASGITransport` has no synchronous counterpart and delays a response until it is complete, which an event stream never
is. This transport runs the application on its own event loop and returns each piece as it is sent.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import AsyncIterator, Coroutine, Iterator
from typing import Any, TypeVar

import httpx
from fastapi import FastAPI

_log = logging.getLogger("pliant.service")

T = TypeVar("T")
Message = dict[str, Any]


class Loop:
    """An application on an event loop in a daemon thread, from construction until `stop`."""

    def __init__(self, app: FastAPI) -> None:
        self.app = app
        self.loop = asyncio.new_event_loop()
        self._stopping = asyncio.Event()
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pliant-in-memory", daemon=True)
        self._thread.start()
        self._started.wait()

    def submit(self, work: Coroutine[Any, Any, T]) -> asyncio.Future[T]:
        """Run a coroutine on the loop and return a future for the caller's running event loop."""
        return asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self.loop))

    def block_on(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine on the loop and return its value."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result()

    def stop(self) -> None:
        """End the application and its thread. The garbage collector may call this on the thread itself."""
        if self._thread.is_alive():
            self.loop.call_soon_threadsafe(self._stopping.set)
            if threading.current_thread() is not self._thread:
                self._thread.join(10)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self.loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        async with self.app.router.lifespan_context(self.app):
            self._started.set()
            await self._stopping.wait()
            self.app.state.service.followers.close()


class Request:
    """One request to the application; its methods are coroutines for the application's loop."""

    def __init__(self, app: FastAPI, request: httpx.Request, body: bytes) -> None:
        url = request.url
        self._scope: Message = {
            "type": "http",
            "asgi": {"version": "3.0"},
            "http_version": "1.1",
            "method": request.method,
            "scheme": url.scheme,
            "path": url.path,
            "raw_path": url.raw_path.partition(b"?")[0],
            "query_string": url.query,
            "root_path": "",
            "headers": [(name.lower(), value) for name, value in request.headers.raw],
            "client": ("127.0.0.1", 1),
            "server": (url.host, url.port or 80),
        }
        self._app = app
        self._body: bytes | None = body
        self._timeout: float | None = request.extensions.get("timeout", {}).get("read")
        self._messages: asyncio.Queue[Message | None] = asyncio.Queue()
        self._closed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> Message:
        """Start the application and return its `http.response.start` message."""
        self._task = asyncio.create_task(self._run())
        message = await self._next()
        if message is None:
            raise httpx.RemoteProtocolError("The application ended without an answer.")
        return message

    async def piece(self) -> bytes | None:
        """Return the next piece of the response's body, None at its end."""
        while (message := await self._next()) is not None:
            if message.get("body"):
                body: bytes = message["body"]
                return body
            if not message.get("more_body", False):
                return None
        return None

    async def close(self) -> None:
        """Disconnect the client."""
        self._closed.set()

    async def _next(self) -> Message | None:
        try:
            return await asyncio.wait_for(self._messages.get(), self._timeout)
        except TimeoutError:
            raise httpx.ReadTimeout(f"No answer within {self._timeout} s.") from None

    async def _run(self) -> None:
        try:
            await self._app(self._scope, self._receive, self._send)
        except Exception:  # noqa: BLE001 - the client has the answer 500; a server, too, logs what caused it
            _log.exception("error in %s %s", self._scope["method"], self._scope["path"])
        finally:
            self._messages.put_nowait(None)

    async def _receive(self) -> Message:
        if self._body is not None:
            body, self._body = self._body, None
            return {"type": "http.request", "body": body, "more_body": False}
        await self._closed.wait()
        return {"type": "http.disconnect"}

    async def _send(self, message: Any) -> None:
        if not self._closed.is_set():
            self._messages.put_nowait(message)


class Body(httpx.SyncByteStream, httpx.AsyncByteStream):
    """The body of a response, for either kind of client."""

    def __init__(self, loop: Loop, request: Request) -> None:
        self._loop = loop
        self._request = request

    def __iter__(self) -> Iterator[bytes]:
        while (piece := self._loop.block_on(self._request.piece())) is not None:
            yield piece

    async def __aiter__(self) -> AsyncIterator[bytes]:
        while (piece := await self._loop.submit(self._request.piece())) is not None:
            yield piece

    def close(self) -> None:
        """Disconnect."""
        self._loop.block_on(self._request.close())

    async def aclose(self) -> None:
        """Disconnect."""
        await self._loop.submit(self._request.close())


def response(start: Message, body: Body) -> httpx.Response:
    """Return the response for the message `start` and a body."""
    return httpx.Response(start["status"], headers=start["headers"], stream=body)

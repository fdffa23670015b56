"""Requests that are still running when the service must end."""

from __future__ import annotations

import asyncio
import json

from pliant.service.middleware.stopping import Stopping
from starlette.types import Message, Receive, Scope, Send


def cancelled(*, begun: bool) -> tuple[list[Message], bool]:
    """Cancel a request that never ends; return what was sent, and whether the cancellation went on to the server."""
    sent: list[Message] = []

    async def endless(scope: Scope, receive: Receive, send: Send) -> None:
        if begun:
            await send({"type": "http.response.start", "status": 200, "headers": []})
        await asyncio.Event().wait()

    async def receive() -> Message:
        return {"type": "http.request", "body": b"", "more_body": True}

    async def send(message: Message) -> None:
        sent.append(message)

    async def run() -> bool:
        scope = {"type": "http", "method": "POST", "path": "/v1/jobs", "headers": []}
        request = asyncio.ensure_future(Stopping(endless)(scope, receive, send))
        await asyncio.sleep(0)
        request.cancel()
        (outcome,) = await asyncio.gather(request, return_exceptions=True)
        return isinstance(outcome, asyncio.CancelledError)

    return sent, asyncio.run(run())


def test_a_request_without_a_response_is_answered_with_what_to_do() -> None:
    (start, body), went_on = cancelled(begun=False)
    assert (start["status"], went_on) == (503, False)
    headers = dict(start["headers"])
    assert headers[b"content-type"] == b"application/problem+json"
    assert headers[b"retry-after"] == b"5"
    problem = json.loads(body["body"])
    assert (problem["code"], problem["retryable"]) == ("not_ready", True)
    assert problem["detail"] == "The service is stopping and has dropped this request. Send it again in 5 s."


def test_a_response_that_has_begun_is_broken_off() -> None:
    sent, went_on = cancelled(begun=True)
    assert ([message["type"] for message in sent], went_on) == (["http.response.start"], True)

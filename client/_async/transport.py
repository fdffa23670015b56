"""Send requests and read responses, with retries."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from typing import TypeVar

import httpx
from pliant.client.call import Call, redirected, request_for
from pliant.client.errors import PliantError, UnexpectedAnswer, Unreachable, error_from
from pliant.client.pauses import async_sleep
from pliant.client.retry import Attempts, may_repeat
from pydantic import BaseModel, ValidationError

R = TypeVar("R", bound=BaseModel)


@dataclass(frozen=True)
class Exchange:
    """The requests of one operation: they share a deadline and a count of failures."""

    http: httpx.AsyncClient
    attempts: Attempts

    async def send(self, call: Call) -> httpx.Response:
        """Send a call once and return the response, whatever its status, with its body unread.

        Raises
        ------
        httpx.TransportError
            The connection failed.
        WaitTimeout
            The deadline has passed.
        """
        with ExitStack() as sending:
            request = request_for(self.http, call, self.attempts.remaining(), sending)
            response = await self.http.send(request, stream=True)
        self.attempts.answered()
        return response

    @asynccontextmanager
    async def stream(self, call: Call) -> AsyncIterator[httpx.Response]:
        """Send a call, with retries, until a successful response begins; close that response at the end.

        A redirect is an error, e.g. a proxy's from http to https, unless the call asks for one.

        Raises
        ------
        APIStatusError, UnexpectedAnswer, Unreachable, WaitTimeout
            See `pliant.client.errors`.
        """
        response = await self._accepted(call)
        try:
            yield response
        finally:
            await response.aclose()

    @asynccontextmanager
    async def download(self, call: Call) -> AsyncIterator[httpx.Response]:
        """Like `stream`, for a file: follow a redirect to the object store, and fall back to the service if that fails."""
        contact = self.attempts.contact
        if contact.follows:
            async with self.stream(replace(call, params={**call.params, "redirect": "true"})) as response:
                location = response.headers.get("location") if response.status_code == 307 else None
                if location is None:
                    yield response
                    return
            found = await self._from_store(location, call)
            if found is not None:
                try:
                    yield found
                finally:
                    await found.aclose()
                return
            contact.follows = False
        async with self.stream(call) as response:
            yield response

    async def _from_store(self, location: str, call: Call) -> httpx.Response | None:
        """Return the object store's response, or None if the store cannot be reached or refuses the request."""
        try:
            response = await self.http.send(redirected(location, call, self.attempts.remaining()), stream=True)
        except (httpx.TransportError, httpx.InvalidURL):
            return None
        if response.status_code in (200, 206):
            return response
        await response.aclose()
        return None

    async def answer(self, call: Call) -> tuple[httpx.Response, bytes]:
        """Send a call and read the complete response; an interrupted response counts as a failure. Raises as `stream`."""
        while True:
            try:
                async with self.stream(call) as response:
                    body = await read(response, self.attempts)
            except httpx.TransportError as lost:
                await self.pause_or_raise(call, lost)
                continue
            self.attempts.succeeded()
            return response, body

    async def record(self, call: Call, kind: type[R]) -> R:
        """Send a call and parse the response as a record of the wire contract. Raises as `stream`."""
        response, body = await self.answer(call)
        return parse(kind, body, response.status_code)

    async def pause_or_raise(self, call: Call, fault: Exception) -> None:
        """Wait before the next attempt, or raise the error that the caller sees."""
        if may_repeat(call, fault):
            await async_sleep(self.attempts.pause_after(fault))
            return
        if isinstance(fault, PliantError):
            raise fault
        self.attempts.remaining()
        raise Unreachable(
            f"{call.method} {call.path} was interrupted ({str(fault) or type(fault).__name__}) and was not sent again, "
            "because it may have been carried out. Check the job before repeating it."
        ) from fault

    async def _accepted(self, call: Call) -> httpx.Response:
        while True:
            fault: Exception
            try:
                response = await self.send(call)
                if response.is_success or (response.status_code == 307 and "redirect" in call.params):
                    return response
                fault = await refusal(response, self.attempts)
            except httpx.TransportError as lost:
                fault = lost
            await self.pause_or_raise(call, fault)


async def read(response: httpx.Response, attempts: Attempts) -> bytes:
    """Read a body, and give up at the deadline if it arrives in pieces: the timeout of the network bounds only the time without a byte."""
    pieces: list[bytes] = []
    async for piece in response.aiter_bytes():
        if pieces:
            attempts.remaining()
        pieces.append(piece)
    return b"".join(pieces)


async def refusal(response: httpx.Response, attempts: Attempts) -> PliantError:
    """Read a response with status 300 or above completely and return the corresponding error."""
    try:
        body = await read(response, attempts)
    finally:
        await response.aclose()
    return error_from(response.status_code, response.headers, body)


def parse(kind: type[R], body: bytes, status: int) -> R:
    """Read JSON as a record.

    Raises
    ------
    UnexpectedAnswer
        The body is not such a record.
    """
    try:
        return kind.model_validate_json(body)
    except ValidationError as fault:
        raise UnexpectedAnswer(
            f"Expected a {kind.__name__} with status {status}, got {body[:200].decode('utf-8', 'replace')!r} "
            f"({fault.error_count()} invalid fields). Check that the address is a Pliant service whose version is "
            "close to this client's."
        ) from fault

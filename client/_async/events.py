"""Follow a job by server-sent events, and resume after the last event if the connection breaks."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import aclosing

import httpx
from pliant.client._async.transport import Exchange
from pliant.client.call import Call
from pliant.client.errors import UnexpectedAnswer
from pliant.client.events import MEDIA_TYPE, Parser, Position, merged
from pliant.client.pauses import async_sleep
from pliant.schemas.job import HEARTBEAT_SECONDS, Job


async def follow(exchange: Exchange, path: str) -> AsyncGenerator[Job, None]:
    """Yield the job each time its record changes; the last one has a final status.

    A broken stream is reopened after the last event (`Last-Event-ID`), with the same retries as any call.
    """
    seen = Position()
    while True:
        async with aclosing(_stream(exchange, path, seen)) as jobs:
            async for job in jobs:
                yield job
        if not seen.final:
            now = await exchange.record(Call(method="GET", path=path), Job)
            if now != seen.job:
                seen.job = now
                yield now
        if seen.final:
            return
        exchange.attempts.remaining()
        await async_sleep(exchange.attempts.retries.poll_interval)


async def _stream(exchange: Exchange, path: str, seen: Position) -> AsyncGenerator[Job, None]:
    """Read one stream until it or the job ends."""
    headers = {"Accept": MEDIA_TYPE} if seen.last_id == "" else {"Accept": MEDIA_TYPE, "Last-Event-ID": seen.last_id}
    call = Call(method="GET", path=f"{path}/events", headers=headers)
    parser = Parser()
    try:
        async with exchange.stream(call) as response:
            kind = response.headers.get("content-type", "no content type")
            if not kind.startswith(MEDIA_TYPE):
                raise UnexpectedAnswer(f"Expected {MEDIA_TYPE}, got {kind}.")
            async for chunk in response.aiter_bytes():
                exchange.attempts.succeeded()
                exchange.attempts.remaining()
                for message in parser.feed(chunk):
                    seen.last_id = message.id or seen.last_id
                    if message.name == "progress" and seen.job is None:
                        return  # the record is older than the events that the service keeps: `follow` reads it
                    job = merged(seen.job, message)
                    if job is not None and job != seen.job:
                        seen.job = job
                        yield job
                    if seen.final:
                        return
                if exchange.attempts.remaining() < HEARTBEAT_SECONDS:
                    return  # a read may take as long as was left when the stream was opened
    except httpx.TransportError as lost:
        await exchange.pause_or_raise(call, lost)

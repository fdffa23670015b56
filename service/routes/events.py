"""A job's events as a stream (server-sent events), and its log."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from contextlib import aclosing
from functools import lru_cache, partial
from typing import Annotated

from anyio import to_thread
from fastapi import Header, Request
from fastapi.responses import PlainTextResponse, Response, StreamingResponse
from fastapi.sse import KEEPALIVE_COMMENT, EventSourceResponse, format_sse_event
from pliant.service.dependencies import Core, Mine
from pliant.service.event_stream import KEPT
from pliant.service.openapi import problems
from pliant.service.routes.jobs import Id
from pliant.service.routes.router import Router
from pliant.worker.errors import WorkerError
from pliant.worker.records import Event

router = Router(prefix="/v1/jobs/{id}", tags=["jobs"])

RECONNECT_MS = 2000
"""Pause before a client reconnects, in milliseconds."""

_log = logging.getLogger("pliant.service")

_STREAM = {
    "text/event-stream": {
        "schema": {
            "type": "object",
            "description": "One event; `data` is the JSON of a `Job` or of its `Progress`.",
            "required": ["id", "event", "data"],
            "properties": {
                "id": {"type": "string", "description": "Ascending; send the last one as `Last-Event-ID` to resume."},
                "event": {"enum": ["job", "progress"]},
                "data": {"type": "string", "contentMediaType": "application/json"},
            },
        },
        "example": 'id: 1-0\nevent: progress\ndata: {"stage": "reweight"}\n\n',
    }
}
_LOG = {"text/plain": {"schema": {"type": "string"}}}


@router.get(
    "/events",
    operation_id="stream_events",
    summary="Follow a job",
    response_class=StreamingResponse,
    responses={
        200: {"description": "Events until the job has ended.", "content": _STREAM},
        204: {"description": "The job has ended, and no event follows `Last-Event-ID`: a browser's EventSource stops."},
        **problems(401, 404, 422, 503),
    },
)
async def events(
    id: Id,
    request: Request,
    core: Core,
    jobs: Mine,
    last: Annotated[str | None, Header(alias="Last-Event-ID", description="The last event received.")] = None,
) -> Response:
    """Stream `job` events (the complete job, whenever its status changes) and `progress` events until the job ends.

    The stream starts with the stored events, or after `Last-Event-ID`, which a browser's EventSource sends automatically.
    A comment line every 15 s keeps proxies from closing the connection. The stream also ends when the token expires or is revoked.
    """
    stream = core.followers.follow(jobs, id, after=last or None, heartbeat=core.settings.heartbeat_seconds)
    # Refuse or end before the stream begins, while a status code can still tell it.
    stored = await to_thread.run_sync(jobs.stored, id)  # before its events, which then include the last
    if not await to_thread.run_sync(partial(jobs.events, id, after=last or None)) and stored.job.status.final:
        return Response(status_code=204, headers={"Cache-Control": "no-store"})
    encoded = _encode(stream, still_valid=request.scope.get("pliant.still_valid"))
    return EventSourceResponse(
        iter(()) if request.method == "HEAD" else encoded,  # an answer without body need not last until the job ends
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


@router.get(
    "/log",
    operation_id="get_log",
    summary="Read a job's log",
    response_class=PlainTextResponse,
    responses={200: {"content": _LOG}, **problems(401, 404, 503)},
)
def log(id: Id, jobs: Mine) -> Response:
    """Return the log lines of the job's attempts so far."""
    return PlainTextResponse(jobs.log(id))


@lru_cache(maxsize=KEPT)
def _encoded(event: Event) -> bytes:
    """Return an event in the format of text/event-stream; all its followers share the bytes."""
    return format_sse_event(id=event.id, event=event.name, data_str=event.data)


async def _encode(
    stream: AsyncGenerator[Event | None], *, still_valid: Callable[[], Awaitable[bool]] | None
) -> AsyncIterator[bytes]:
    """Yield events in the format of text/event-stream while the request's token is valid."""
    yield format_sse_event(retry=RECONNECT_MS)
    try:
        async with aclosing(stream):
            async for event in stream:
                if still_valid is not None and not await still_valid():
                    return
                if event is None:
                    yield KEEPALIVE_COMMENT
                else:
                    yield _encoded(event)
    except WorkerError as error:
        # The store does not answer or the job was deleted: the client reconnects with Last-Event-ID and gets an error status.
        _log.warning("an event stream ended early: %s", error)

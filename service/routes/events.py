"""A job's changes as they happen (server-sent events), and its log."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable
from contextlib import aclosing
from functools import partial
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Header, Request
from fastapi.responses import PlainTextResponse, Response, StreamingResponse
from pliant.service.dependencies import Core, Mine
from pliant.service.openapi import problems
from pliant.service.routes.jobs import Id
from pliant.worker.errors import WorkerError
from pliant.worker.records import Event

router = APIRouter(prefix="/v1/jobs/{id}", tags=["jobs"])

_STREAM = {
    "text/event-stream": {
        "schema": {
            "type": "object",
            "description": "One event; `data` is the JSON of a `Job` or of its `Progress`.",
            "required": ["id", "event", "data"],
            "properties": {
                "id": {"type": "string", "description": "Ascending; send the last one as `Last-Event-ID` to go on."},
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
    summary="Follow a job",
    response_class=StreamingResponse,
    responses={
        200: {"description": "Events until the job has ended.", "content": _STREAM},
        **problems(401, 404, 422, 503),
    },
)
async def events(
    id: Id,
    request: Request,
    core: Core,
    jobs: Mine,
    last: Annotated[str | None, Header(alias="Last-Event-ID", description="The last event you have.")] = None,
) -> Response:
    """Stream `job` events (the whole job, when its status changed) and `progress` events, and end when the job has.

    Begins with the events that are kept, or after `Last-Event-ID`; a browser's EventSource sends that by itself.
    A comment line every 15 s keeps the connection from being taken for dead. Ends, too, when the token was revoked or is over.
    """
    stream = core.followers.follow(jobs, id, after=last or None, heartbeat=core.settings.heartbeat_seconds)
    # What can be refused is refused before the stream begins: afterwards there is no status code to say it with.
    await to_thread.run_sync(partial(jobs.events, id, after=last or None))
    return StreamingResponse(
        _written(stream, still_good=request.scope.get("pliant.still_good")),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


@router.get(
    "/log",
    summary="Read a job's log",
    response_class=PlainTextResponse,
    responses={200: {"content": _LOG}, **problems(401, 404, 503)},
)
def log(id: Id, jobs: Mine) -> Response:
    """Return what the job's attempts have logged so far, one line an entry."""
    return PlainTextResponse(jobs.log(id))


async def _written(
    stream: AsyncGenerator[Event | None], *, still_good: Callable[[], Awaitable[bool]] | None
) -> AsyncIterator[str]:
    """Yield events as the lines of a text/event-stream, as long as whoever listens still may."""
    yield "retry: 2000\n\n"
    try:
        async with aclosing(stream):
            async for event in stream:
                if still_good is not None and not await still_good():
                    return
                said = "" if event is None else f"id: {event.id}\nevent: {event.name}\ndata: {event.data}\n\n"
                yield said or ": still here\n\n"
    except WorkerError:
        # The store went away or the job was deleted: the client comes back with Last-Event-ID and is told by a status.
        return

"""Dependencies of the routes: the application's state, and the jobs, uploads and limits of the request's token."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Annotated, TypeVar

from fastapi import Depends, Request
from fastapi.routing import APIRoute
from pliant.schemas.problems import ProblemCode
from pliant.schemas.suggestions import closest
from pliant.service.event_stream import Followers
from pliant.service.metrics import Metrics
from pliant.service.problems import wrong_input
from pliant.service.settings import ServiceSettings
from pliant.service.spool import Incoming, ParserSlots
from pliant.service.upload_locks import UploadLocks
from pliant.worker.formats import Limits
from pliant.worker.jobs.service import Jobs
from pliant.worker.tokens import Token
from pliant.worker.uploads.service import Uploads

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Service:
    """The state of an application, which all requests share."""

    jobs: Jobs
    """The jobs of all owners; routes use `Mine` instead."""
    settings: ServiceSettings
    limits: Limits
    """Largest inputs that the readers accept."""
    incoming: Incoming
    followers: Followers
    uploads: Uploads
    """The uploads of all owners; routes use `MyUploads` instead."""
    upload_locks: UploadLocks
    metrics: Metrics
    parsing: ParserSlots
    """Limits the number of inputs in memory at once."""


def service_of(request: Request) -> Service:
    """Return the state of the request's application."""
    service = request.app.state.service
    assert isinstance(service, Service)
    return service


async def known_parameters(request: Request) -> None:
    """Refuse a query parameter that a route of the API does not have: a misspelled filter would have no effect."""
    route = request.scope["route"]
    assert isinstance(route, APIRoute)
    if not route.path.startswith("/v1/"):  # monitoring systems and load balancers add parameters of their own
        return
    known = [field.alias for field in route.dependant.query_params]
    for name in request.query_params:
        if name not in known:
            meant = closest(name, known)
            raise wrong_input(
                ProblemCode.UNKNOWN_PARAMETER,
                field=name,
                expected=f"one of {', '.join(sorted(known))}" if known else "no query parameters",
                got=name,
                hint=f"Did you mean `{meant}`?" if meant else "Omit it; the parameters of every path are at /docs.",
            )


@dataclass(frozen=True)
class Bounds:
    """The limits of a request's token, or the service's defaults where the token has none. 0 means no limit."""

    max_body_bytes: int
    max_upload_bytes: int
    max_queued: int
    max_running: int
    requests_per_minute: int


def bounds_of(request: Request) -> Bounds:
    """Return the limits of the request's token."""
    service, token = service_of(request), request.scope.get("pliant.token")
    settings = service.settings
    assert token is None or isinstance(token, Token)
    most = float("inf") if token is None or token.max_body_bytes is None else token.max_body_bytes

    def own(name: str, usual: int) -> int:
        limit = getattr(token, name, None)
        return usual if limit is None else int(limit)

    return Bounds(
        max_body_bytes=int(min(most, settings.max_body_bytes)),
        max_upload_bytes=int(min(most, service.limits.max_bytes)),
        max_queued=own("max_queued", settings.max_queued),
        max_running=own("max_running", service.jobs.settings.max_running),
        requests_per_minute=settings.rate_of(None if token is None else token.requests_per_minute),
    )


def mine(request: Request) -> Jobs:
    """Return the jobs that the request's token may see: its own, or all for an `admin` token and with tokens off."""
    owner = request.scope.get("pliant.owner")
    token = request.scope.get("pliant.token")
    return replace(
        service_of(request).jobs,
        owner=owner,
        max_queued=bounds_of(request).max_queued,
        max_running=None if token is None else token.max_running,
    )


def my_uploads(request: Request) -> Uploads:
    """Return the uploads of the request's owner; with tokens off all requests have the same owner."""
    return service_of(request).uploads.of(request.scope.get("pliant.owner") or "")


def _at_once(part: Callable[[Request], Answer]) -> Callable[[Request], Awaitable[Answer]]:
    """Return the function as a dependency that needs no thread: calls of the store may occupy all of them."""

    async def dependency(request: Request) -> Answer:
        return part(request)

    return dependency


Core = Annotated[Service, Depends(_at_once(service_of))]
Mine = Annotated[Jobs, Depends(_at_once(mine))]
MyUploads = Annotated[Uploads, Depends(_at_once(my_uploads))]
Bound = Annotated[Bounds, Depends(_at_once(bounds_of))]

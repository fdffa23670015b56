"""What every route works with: one record, made by `create_app` and handed down through the request."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import anyio
from fastapi import Depends, Request
from pliant.service.follow import Followers
from pliant.service.incoming import Incoming
from pliant.service.settings import ServiceSettings
from pliant.service.turns import Turns
from pliant.worker.formats import Limits
from pliant.worker.jobs import Jobs
from pliant.worker.uploads import Uploads


@dataclass(frozen=True)
class Service:
    """The parts that outlive a request."""

    jobs: Jobs
    """Everybody's jobs; a route takes `Mine` instead."""
    settings: ServiceSettings
    limits: Limits
    """What the readers accept."""
    incoming: Incoming
    followers: Followers
    uploads: Uploads
    """Everybody's uploads; a route takes `MyUploads` instead."""
    turns: Turns
    parsing: anyio.CapacityLimiter
    """Holds the number of inputs that are in memory at once."""


def service_of(request: Request) -> Service:
    """Return the record of the application that answers this request."""
    service = request.app.state.service
    assert isinstance(service, Service)
    return service


def mine(request: Request) -> Jobs:
    """Return the jobs that the request's token may see: its own, or everybody's where tokens are off."""
    owner = request.scope.get("pliant.owner")
    jobs = service_of(request).jobs
    return jobs if owner is None else jobs.of(owner)


def my_uploads(request: Request) -> Uploads:
    """Return the uploads of the request's token, or everybody's where tokens are off."""
    return service_of(request).uploads.of(request.scope.get("pliant.owner") or "")


Core = Annotated[Service, Depends(service_of)]
Mine = Annotated[Jobs, Depends(mine)]
MyUploads = Annotated[Uploads, Depends(my_uploads)]

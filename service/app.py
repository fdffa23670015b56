"""The assembly of the application: routes, middleware and the handlers of errors."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import Depends, FastAPI
from pliant.schemas.digests import REPR_DIGEST
from pliant.service import openapi, problems
from pliant.service.dependencies import Service, known_parameters
from pliant.service.event_stream import Followers
from pliant.service.metrics import CountRequests, Metrics
from pliant.service.middleware.access_log import HEADER as REQUEST_ID_HEADER
from pliant.service.middleware.access_log import AccessLog
from pliant.service.middleware.auth import Authentication
from pliant.service.middleware.lingering_close import LingeringClose
from pliant.service.middleware.origin import OriginCheck
from pliant.service.middleware.rate_limit import RateLimit
from pliant.service.middleware.security_headers import SECURITY_HEADERS, SecurityHeaders
from pliant.service.middleware.stopping import Stopping
from pliant.service.middleware.tracing import Tracing
from pliant.service.page import mount_page
from pliant.service.routes import artifacts, events, examples, inspection, jobs, meta, outputs, shares, uploads
from pliant.service.routes import errors as error_pages
from pliant.service.routes import metrics as metrics_route
from pliant.service.settings import ServiceSettings
from pliant.service.spool import Incoming, ParserSlots
from pliant.service.upload_locks import UploadLocks
from pliant.worker.formats import Limits
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Records
from pliant.worker.tokens import Tokens
from pliant.worker.uploads.shared import open_uploads
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware

ROUTES = (
    jobs, outputs, shares, inspection, uploads, artifacts, events, meta, metrics_route, examples, error_pages,
)  # fmt: skip
"""In the order of the API reference."""


def create_app(
    jobs_of_all: Jobs, settings: ServiceSettings, *, tokens: Tokens, limits: Limits | None = None
) -> FastAPI:
    """Return the application for the jobs of all owners; it does not use their store before the first request.

    `limits` bounds the inputs that the readers accept; None: the default limits, with `read_memory` from the jobs' settings.
    """
    metrics = Metrics()
    memory = jobs_of_all.settings.read_memory
    limits = limits or Limits(read_memory=memory, parse_memory=min(memory, Limits().parse_memory))
    app = FastAPI(
        title="Pliant",
        summary=openapi.SUMMARY,
        description=openapi.DESCRIPTION,
        version=version("pliant"),
        lifespan=lambda app: _parts(app, jobs_of_all, settings, limits=limits, metrics=metrics),
        openapi_tags=openapi.TAGS,
        # Relative to the document: a proxy may serve it under a path.
        servers=[{"url": ".", "description": "This service"}],
        middleware=middleware(settings, tokens, metrics, jobs_of_all.records),
        docs_url=None,  # FastAPI's page loads Swagger UI from a CDN, which the content-security policy forbids; see `page`
        redoc_url=None,
        redirect_slashes=False,  # behind a proxy, the absolute address of such a redirect would be that of plain http
    )
    routes = [route for each in ROUTES for route in each.router.routes]
    problems.install(app, routes=routes, security_headers=SECURITY_HEADERS)
    for each in ROUTES:
        app.include_router(each.router, dependencies=[Depends(known_parameters)])
    mount_page(app)
    app.openapi = lambda: openapi.document(app)  # type: ignore[method-assign]
    return app


@asynccontextmanager
async def _parts(
    app: FastAPI, jobs_of_all: Jobs, settings: ServiceSettings, *, limits: Limits, metrics: Metrics
) -> AsyncIterator[None]:
    """Create the state that the routes use when the application starts; close it at shutdown."""
    incoming = Incoming(jobs_of_all.settings.incoming)
    incoming.open()
    app.state.service = Service(
        jobs=jobs_of_all,
        settings=settings,
        limits=limits,
        incoming=incoming,
        followers=Followers(),
        metrics=metrics,
        uploads=open_uploads(jobs_of_all.settings, jobs_of_all.blobs),
        upload_locks=UploadLocks(),
        parsing=ParserSlots(settings.parsers),
    )
    yield
    incoming.close()


def middleware(settings: ServiceSettings, tokens: Tokens, metrics: Metrics, records: Records) -> list[Middleware]:
    """Return the middleware, the outermost first."""
    stack = [
        Middleware(AccessLog),
        Middleware(Tracing),
        Middleware(CountRequests, metrics=metrics),
        Middleware(SecurityHeaders),
        Middleware(LingeringClose),
        Middleware(Stopping),
        Middleware(OriginCheck, settings=settings),
    ]
    if settings.cors_origins:
        stack.append(
            Middleware(
                CORSMiddleware,
                allow_origins=settings.cors_origins,
                allow_methods=["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE"],
                allow_headers=[
                    *("Authorization", "Content-Type", "Idempotency-Key", "Last-Event-ID", "Prefer", "Range"),
                    *("If-Match", "If-None-Match", "If-Range"),
                    REQUEST_ID_HEADER,
                    *(REPR_DIGEST, "Upload-Complete", "Upload-Length", "Upload-Offset"),
                ],
                expose_headers=[
                    "Location",
                    "ETag",
                    "Content-Range",
                    REPR_DIGEST,
                    "Retry-After",
                    "Preference-Applied",
                    REQUEST_ID_HEADER,
                    *("Upload-Complete", "Upload-Length", "Upload-Limit", "Upload-Offset"),
                ],
            )
        )
    # Inside CORS: a browser's preflight has no token, and pages of allowed origins must be able to read a refusal.
    stack.append(Middleware(Authentication, settings=settings, tokens=tokens, records=records))
    stack.append(Middleware(RateLimit, settings=settings))
    return stack

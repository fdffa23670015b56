"""The application: the parts put together, and nothing else."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import FastAPI
from pliant.service import openapi, problems
from pliant.service.dependencies import Service
from pliant.service.event_stream import Followers
from pliant.service.metrics import Counting, Requests
from pliant.service.middleware.auth import Authentication
from pliant.service.middleware.lingering_close import LingeringClose
from pliant.service.middleware.origin import EVERY_ANSWER, OriginGuard, SecurityHeaders
from pliant.service.middleware.rate_limit import RateLimit
from pliant.service.page import mount_page
from pliant.service.routes import artifacts, events, examples, inspection, jobs, meta, metrics, uploads
from pliant.service.settings import ServiceSettings
from pliant.service.spool import Incoming, ParserSlots
from pliant.service.upload_locks import Turns
from pliant.worker import errors
from pliant.worker.formats import InvalidInput, Limits
from pliant.worker.jobs.service import Jobs
from pliant.worker.tokens import Tokens
from pliant.worker.uploads.service import Uploads
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import ClientDisconnect

STATUS_OF: dict[type[Exception], int] = {
    InvalidInput: 422,
    errors.UnknownJob: 404,
    errors.UnknownArtifact: 404,
    errors.UnknownExample: 404,
    errors.UnknownToken: 404,
    errors.UnknownUpload: 404,
    errors.NotAllowedNow: 409,
    errors.Conflict: 409,
    errors.InvalidRequest: 422,
    errors.UploadTooLarge: 413,
    errors.TooManyUploads: 429,
    errors.TooManyQueued: 429,
    errors.QuotaExceeded: 507,
    errors.StoreUnavailable: 503,
    errors.WorkerError: 500,
    ClientDisconnect: 400,  # nobody is left to read it
}
"""What each error means in HTTP; a subclass takes its nearest base's."""


def create_app(
    jobs_of_all: Jobs,
    settings: ServiceSettings,
    *,
    tokens: Tokens,
    limits: Limits | None = None,
) -> FastAPI:
    """Make the application.

    Parameters
    ----------
    jobs_of_all : Jobs
        The jobs; nothing is asked of them before the first request.
    settings : ServiceSettings
        How the service runs.
    tokens : Tokens
        Who may ask, where the settings say that tokens are asked for.
    limits : Limits, optional
        What the readers accept; None: the usual limits, with `read_memory` of the jobs' settings.
    """
    requests = Requests()
    limits = limits or Limits(read_memory=jobs_of_all.settings.read_memory)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        incoming = Incoming(settings.incoming)
        incoming.open()
        app.state.service = Service(
            jobs=jobs_of_all,
            settings=settings,
            limits=limits,
            incoming=incoming,
            followers=Followers(),
            requests=requests,
            uploads=Uploads.open(jobs_of_all.settings),
            turns=Turns(),
            parsing=ParserSlots(settings.parsers),
        )
        yield
        incoming.close()

    app = FastAPI(
        title="Pliant",
        summary=openapi.SUMMARY,
        description=openapi.DESCRIPTION,
        version=version("pliant"),
        lifespan=lifespan,
        middleware=middleware(settings, tokens, requests),
        docs_url=None,  # FastAPI's page loads scripts from elsewhere, which our own content-security policy forbids
        redoc_url=None,
    )
    problems.install(app, STATUS_OF, careful=EVERY_ANSWER)
    for each in (jobs, inspection, uploads, artifacts, events, meta, metrics, examples):
        app.include_router(each.router)
    mount_page(app)
    app.openapi = lambda: openapi.document(app)  # type: ignore[method-assign]
    return app


def middleware(settings: ServiceSettings, tokens: Tokens, requests: Requests) -> list[Middleware]:
    """Return what every request passes, the outermost first."""
    stack = [
        Middleware(Counting, requests=requests),
        Middleware(SecurityHeaders),
        Middleware(LingeringClose),
        Middleware(OriginGuard, settings=settings),
    ]
    if settings.cors_origins:
        stack.append(
            Middleware(
                CORSMiddleware,
                allow_origins=settings.cors_origins,
                allow_methods=["GET", "POST", "PUT", "PATCH", "DELETE"],
                allow_headers=[
                    *("Authorization", "Content-Type", "Idempotency-Key", "Last-Event-ID", "Prefer", "Range"),
                    *("Repr-Digest", "Upload-Complete", "Upload-Length", "Upload-Offset"),
                ],
                expose_headers=[
                    "Location",
                    "ETag",
                    "Content-Range",
                    "Repr-Digest",
                    "Retry-After",
                    "Preference-Applied",
                    *("Upload-Complete", "Upload-Length", "Upload-Limit", "Upload-Offset"),
                ],
            )
        )
    # Inside CORS: a browser's preflight carries no token, and a page of an allowed origin may read why it was refused.
    stack.append(Middleware(Authentication, settings=settings, tokens=tokens))
    stack.append(Middleware(RateLimit, settings=settings))
    return stack

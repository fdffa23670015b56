"""The application on in-memory stores, as an httpx transport."""

from __future__ import annotations

import weakref
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import httpx
from pliant.schemas.job import Problem
from pliant.service.app import create_app
from pliant.service.settings import ServiceSettings
from pliant.service.testing.reconstruction import DeliveringQueue, Reconstruct, Worker, flat
from pliant.service.testing.transport import Body, Loop, Request, response
from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.memory import MemoryHash, MemoryRecords
from pliant.worker.tokens import Scope, Tokens


class InMemoryService(httpx.BaseTransport, httpx.AsyncBaseTransport):
    """A Pliant service in this process; pass it as `transport` to any number of clients.

    Parameters
    ----------
    reconstruct : Reconstruct or None
        Replaces the solver: called with the points (F, P, 2), NaN where hidden, and the job's `Options`; returns the shapes (F, P, 3). By
        default `flat`, which is instant. None runs the real solver.
    steps : float
        Progress reports before a job ends, 20 ms apart; `math.inf` runs each job until it is cancelled.
    problem : Problem, optional
        Every job fails with this error.
    auth : {"off", "required"}
        Whether requests need a token; `create_token` makes one.

    Attributes
    ----------
    requests : list of httpx.Request
        Requests received so far, with their bodies.
    jobs : Jobs
        The service's jobs, as the routes see them.
    worker : Worker
        The thread that runs them; its `steps` may be changed.
    folder : Path
        Files that are being received, and uploads.
    """

    def __init__(
        self,
        reconstruct: Reconstruct | None = flat,
        *,
        steps: float = 0,
        problem: Problem | None = None,
        auth: Literal["off", "required"] = "off",
    ) -> None:
        self._scratch = TemporaryDirectory(prefix="pliant-in-memory-", ignore_cleanup_errors=True)
        self.folder = Path(self._scratch.name)
        self.requests: list[httpx.Request] = []
        self.jobs = Jobs(
            records=MemoryRecords(),
            blobs=Blobs.open("memory:///"),
            queue=DeliveringQueue(),
            settings=Settings(data=self.folder),
        )
        self.tokens = Tokens(MemoryHash(), prefix="memory")  # type: ignore[arg-type]  # the commands that Tokens uses
        # Any Host header is answered: the address of an in-memory service is arbitrary.
        settings = ServiceSettings(
            host="0.0.0.0",  # noqa: S104 - nothing is bound
            auth=auth,
            requests_per_minute=0,
        )
        self.worker = Worker(self.jobs, reconstruct, steps=steps, problem=problem)
        self._loop = Loop(create_app(self.jobs, settings, tokens=self.tokens))
        self._finalizer = weakref.finalize(self, _stop, self._loop, self.worker, self._scratch)

    def create_token(self, name: str = "test", *, scopes: tuple[Scope, ...] = (Scope.READ, Scope.SUBMIT)) -> str:
        """Return a new token."""
        return self.tokens.create(name, scopes=scopes)[1]

    def stop(self) -> None:
        """End the threads and remove the files; called automatically when the service is no longer referenced."""
        self._finalizer()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Answer a request; override it in a subclass to simulate faults."""
        sent = Request(self._loop.app, request, request.read())
        self.requests.append(request)
        return response(self._loop.block_on(sent.start()), Body(self._loop, sent))

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Answer a request of an asynchronous client."""
        sent = Request(self._loop.app, request, await request.aread())
        self.requests.append(request)
        return response(await self._loop.submit(sent.start()), Body(self._loop, sent))

    def __exit__(self, *_: Any) -> None:
        """Stay usable after a client has closed its connections."""

    async def __aexit__(self, *_: Any) -> None:
        """Stay usable after a client has closed its connections."""


def _stop(loop: Loop, worker: Worker, scratch: TemporaryDirectory[str]) -> None:
    worker.stop()
    loop.stop()
    scratch.cleanup()

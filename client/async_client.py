"""The asynchronous client: the verbs of the synchronous one, awaited. A test holds the two together."""

from __future__ import annotations

import tempfile
from collections.abc import AsyncIterator, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx
from numpy.typing import ArrayLike
from pliant.client import operations
from pliant.client.async_remote import AsyncRemoteJob, AsyncResult
from pliant.client.drive import aiterate, arun
from pliant.client.multipart import Inputs, OnBytes, Source
from pliant.client.operations import OnJob
from pliant.client.request import base_of, headers_of
from pliant.client.result import LOADED
from pliant.client.retry import Attempts, Contact, Policy
from pliant.schemas.job import Interpretation, Job, ServiceLimits, Status
from pliant.schemas.options import Options

DEFAULT_URL = "http://127.0.0.1:8000"


class AsyncClient:
    """A Pliant service, seen from here.

    Parameters
    ----------
    url : str
        Where `pliant up` listens.
    token : str, optional
        Sent as `Authorization: Bearer`.
    policy : Policy
        How patiently calls are repeated.
    transport : httpx.AsyncBaseTransport, optional
        Instead of the network, e.g. `pliant.client.testing.FakeService`.

    Examples
    --------
    ``(await (await AsyncClient().submit(points)).wait(timeout=600)).shapes`` is an array (F, P, 3).
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        token: str | None = None,
        policy: Policy = Policy(),  # noqa: B008 - frozen, so one for all is safe
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.url = base_of(url)
        self._http = httpx.AsyncClient(base_url=self.url, headers=headers_of(token), transport=transport)
        self._policy = policy
        self._contact = Contact()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Give up the connections."""
        await self._http.aclose()

    async def submit(
        self,
        tracks: Source,
        *,
        visible: ArrayLike | None = None,
        mesh: Source | tuple[int, int] | None = None,
        ground_truth: Source | None = None,
        rotations: Source | None = None,
        options: Options | Mapping[str, Any] | None = None,
        name: str = "",
        job_id: str | None = None,
        idempotency_key: str | None = None,
        webhook: str | None = None,
        webhook_secret: str | None = None,
        on_upload: OnBytes | None = None,
        timeout: float | None = None,
    ) -> AsyncRemoteJob:
        """As `Client.submit`."""
        inputs = Inputs(tracks=tracks, visible=visible, mesh=mesh, ground_truth=ground_truth, rotations=rotations)
        with tempfile.TemporaryDirectory(prefix="pliant-submit-") as folder:
            flow = operations.submit(
                self._attempts(timeout, "the submission"),
                inputs,
                folder=Path(folder),
                options=options,
                name=name,
                job_id=job_id,
                idempotency_key=idempotency_key,
                webhook=webhook,
                webhook_secret=webhook_secret,
                on_upload=on_upload,
            )
            return AsyncRemoteJob(self, await arun(self._http, flow))

    async def inspect(
        self,
        tracks: Source,
        *,
        visible: ArrayLike | None = None,
        mesh: Source | tuple[int, int] | None = None,
        ground_truth: Source | None = None,
        rotations: Source | None = None,
        options: Options | Mapping[str, Any] | None = None,
        on_upload: OnBytes | None = None,
        timeout: float | None = None,
    ) -> Interpretation:
        """As `Client.inspect`."""
        inputs = Inputs(tracks=tracks, visible=visible, mesh=mesh, ground_truth=ground_truth, rotations=rotations)
        with tempfile.TemporaryDirectory(prefix="pliant-inspect-") as folder:
            flow = operations.inspect(
                self._attempts(timeout, "the inspection"),
                inputs,
                folder=Path(folder),
                options=options,
                on_upload=on_upload,
            )
            return await arun(self._http, flow)

    async def get(self, job: str, *, timeout: float | None = None) -> AsyncRemoteJob:
        """As `Client.get`."""
        return AsyncRemoteJob(self, await arun(self._http, operations.get(self._attempts(timeout), job)))

    async def list(
        self, *, statuses: Iterable[Status | str] = (), page_size: int = 50, timeout: float | None = None
    ) -> AsyncIterator[AsyncRemoteJob]:
        """As `Client.list`."""
        flow = operations.jobs(self._attempts(timeout), statuses=statuses, page_size=page_size)
        async for job in aiterate(self._http, flow):
            yield AsyncRemoteJob(self, job)

    async def wait(
        self,
        job: str,
        *,
        on_progress: OnJob | None = None,
        folder: Path | str | None = None,
        load: bool = True,
        timeout: float | None = None,
    ) -> AsyncResult:
        """As `Client.wait`."""
        attempts = self._attempts(timeout, f"job {job}")
        final = operations.succeeded(await arun(self._http, operations.wait(attempts, job, on_progress=on_progress)))
        result = AsyncResult(self, final, folder)
        if load:
            await arun(self._http, operations.fetch(attempts, final, result.folder, names=LOADED, on_download=None))
        return result

    async def events(self, job: str, *, timeout: float | None = None) -> AsyncIterator[Job]:
        """As `Client.events`."""
        async for now in aiterate(self._http, operations.events(self._attempts(timeout, f"job {job}"), job)):
            yield now

    async def result(
        self, job: str, *, folder: Path | str | None = None, load: bool = True, timeout: float | None = None
    ) -> AsyncResult:
        """As `Client.result`."""
        attempts = self._attempts(timeout, f"the result of job {job}")
        final = operations.finished(await arun(self._http, operations.get(attempts, job)))
        result = AsyncResult(self, final, folder)
        if load:
            await arun(self._http, operations.fetch(attempts, final, result.folder, names=LOADED, on_download=None))
        return result

    async def log(self, job: str, *, timeout: float | None = None) -> str:
        """As `Client.log`."""
        return await arun(self._http, operations.log(self._attempts(timeout), job))

    async def cancel(self, job: str, *, timeout: float | None = None) -> AsyncRemoteJob:
        """As `Client.cancel`."""
        return AsyncRemoteJob(self, await arun(self._http, operations.cancel(self._attempts(timeout), job)))

    async def retry(self, job: str, *, timeout: float | None = None) -> AsyncRemoteJob:
        """As `Client.retry`."""
        return AsyncRemoteJob(self, await arun(self._http, operations.retry(self._attempts(timeout), job)))

    async def delete(self, job: str, *, timeout: float | None = None) -> None:
        """As `Client.delete`."""
        await arun(self._http, operations.delete(self._attempts(timeout), job))

    async def download(
        self,
        job: str,
        folder: Path | str,
        *,
        names: Iterable[str] | None = None,
        on_download: OnBytes | None = None,
        timeout: float | None = None,
    ) -> dict[str, Path]:
        """As `Client.download`."""
        attempts = self._attempts(timeout, f"the files of job {job}")
        record = await arun(self._http, operations.get(attempts, job))
        return await arun(
            self._http, operations.fetch(attempts, record, Path(folder), names=names, on_download=on_download)
        )

    async def options(self, *, timeout: float | None = None) -> dict[str, Any]:
        """As `Client.options`."""
        return await arun(self._http, operations.document(self._attempts(timeout), "/v1/options"))

    async def limits(self, *, timeout: float | None = None) -> ServiceLimits:
        """As `Client.limits`."""
        return await arun(self._http, operations.limits(self._attempts(timeout)))

    async def ready(self, *, timeout: float | None = None) -> dict[str, Any]:
        """As `Client.ready`."""
        return await arun(self._http, operations.document(self._attempts(timeout), "/readyz"))

    def _attempts(self, timeout: float | None, doing: str = "this call") -> Attempts:
        return Attempts(policy=self._policy, contact=self._contact, timeout=timeout, doing=doing)

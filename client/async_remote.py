"""What the asynchronous client hands out: a job of the service, and its result."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Self

from pliant.client.multipart import OnBytes
from pliant.client.operations import OnJob
from pliant.client.result import ANIMATION, LOADED, Reconstruction, copied
from pliant.schemas.job import Job, Status

if TYPE_CHECKING:
    from pliant.client.async_client import AsyncClient


class AsyncRemoteJob:
    """A job of a service: its record as last seen, and the verbs that apply to it.

    Attributes
    ----------
    record : Job
        What the service said last; `refresh` asks again.
    """

    def __init__(self, client: AsyncClient, record: Job) -> None:
        self._client = client
        self.record = record

    def __repr__(self) -> str:
        return f"<AsyncRemoteJob {self.id} {self.status}>"

    @property
    def id(self) -> str:
        """The job's id."""
        return self.record.id

    @property
    def status(self) -> Status:
        """As `RemoteJob.status`."""
        return self.record.status

    async def refresh(self, *, timeout: float | None = None) -> Self:
        """As `RemoteJob.refresh`."""
        self.record = (await self._client.get(self.id, timeout=timeout)).record
        return self

    async def wait(
        self,
        *,
        on_progress: OnJob | None = None,
        folder: Path | str | None = None,
        load: bool = True,
        timeout: float | None = None,
    ) -> AsyncResult:
        """As `RemoteJob.wait`."""
        return await self._client.wait(self.id, on_progress=on_progress, folder=folder, load=load, timeout=timeout)

    async def events(self, *, timeout: float | None = None) -> AsyncIterator[Job]:
        """As `RemoteJob.events`."""
        async for job in self._client.events(self.id, timeout=timeout):
            self.record = job
            yield job

    async def log(self, *, timeout: float | None = None) -> str:
        """As `RemoteJob.log`."""
        return await self._client.log(self.id, timeout=timeout)

    async def cancel(self, *, timeout: float | None = None) -> Self:
        """As `RemoteJob.cancel`."""
        self.record = (await self._client.cancel(self.id, timeout=timeout)).record
        return self

    async def retry(self, *, timeout: float | None = None) -> AsyncRemoteJob:
        """As `RemoteJob.retry`."""
        return await self._client.retry(self.id, timeout=timeout)

    async def delete(self, *, timeout: float | None = None) -> None:
        """As `RemoteJob.delete`."""
        await self._client.delete(self.id, timeout=timeout)


class AsyncResult(Reconstruction):
    """The result of a job; files that are not here yet are fetched by its methods."""

    def __init__(self, client: AsyncClient, job: Job, folder: Path | str | None) -> None:
        super().__init__(job, folder)
        self._client = client

    async def load(self, *, timeout: float | None = None) -> Self:
        """Fetch the arrays and the report."""
        await self._client.download(self.job.id, self.folder, names=LOADED, timeout=timeout)
        return self

    async def download(
        self,
        folder: Path | str,
        *,
        names: Iterable[str] | None = None,
        on_download: OnBytes | None = None,
        timeout: float | None = None,
    ) -> dict[str, Path]:
        """As `Result.download`."""
        return await self._client.download(self.job.id, folder, names=names, on_download=on_download, timeout=timeout)

    async def save_glb(self, path: Path | str, *, timeout: float | None = None) -> Path:
        """As `Result.save_glb`."""
        held = await self._client.download(self.job.id, self.folder, names=[ANIMATION], timeout=timeout)
        return copied(held[ANIMATION], path)

"""The objects that the client returns: a job of the service, and its result."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterable, Mapping
from contextlib import aclosing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from pliant.client._async.operations import OnJob
from pliant.client.errors import JobEnded
from pliant.client.multipart import OnBytes
from pliant.client.result import ANIMATION, Reconstruction, copied, loaded, without_client
from pliant.schemas.job import Job, Status
from pliant.schemas.options import Options, Output
from pliant.schemas.shares import Share

if TYPE_CHECKING:
    from pliant.client._async.client import AsyncClient


class AsyncRemoteJob:
    """A job of a service: its latest known record, and its operations.

    Attributes
    ----------
    record : Job
        As of the last call; `refresh` updates it.
    """

    def __init__(self, client: AsyncClient, record: Job) -> None:
        self._client = client
        self.record = record

    def __repr__(self) -> str:
        return f"<AsyncRemoteJob {self.id} {self.status.value}>"

    @property
    def id(self) -> str:
        """The job's id."""
        return self.record.id

    @property
    def status(self) -> Status:
        """The status as of the last call."""
        return self.record.status

    async def refresh(self, *, timeout: float | None = None) -> Self:
        """Read the record again."""
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
        """Wait until the job is finished and return its result: see `AsyncClient.wait`."""

        def report(job: Job) -> None:
            self.record = job
            if on_progress is not None:
                on_progress(job)

        try:
            result = await self._client.wait(
                self.id, on_progress=None if on_progress is None else report, folder=folder, load=load, timeout=timeout
            )
        except JobEnded as ended:
            self.record = ended.job
            raise
        self.record = result.job
        return result

    async def events(self, *, timeout: float | None = None) -> AsyncGenerator[Job, None]:
        """Yield the record each time it changes; the last one has a final status."""
        async with aclosing(self._client.events(self.id, timeout=timeout)) as changes:
            async for job in changes:
                self.record = job
                yield job

    async def log(self, *, timeout: float | None = None) -> str:
        """Return the job's log so far, one entry per line."""
        return await self._client.log(self.id, timeout=timeout)

    async def cancel(self, *, timeout: float | None = None) -> Self:
        """Request cancellation of the job."""
        self.record = (await self._client.cancel(self.id, timeout=timeout)).record
        return self

    async def retry(self, *, idempotency_key: str | None = None, timeout: float | None = None) -> AsyncRemoteJob:
        """Queue and return a new job with the same inputs and options, after this one failed or was cancelled."""
        return await self._client.retry(self.id, idempotency_key=idempotency_key, timeout=timeout)

    async def make_outputs(
        self,
        outputs: Iterable[Output] | str,
        *,
        fps: float | None = None,
        idempotency_key: str | None = None,
        timeout: float | None = None,
        **options: Any,
    ) -> AsyncRemoteJob:
        """Queue and return a job that writes further files from the result: see `AsyncClient.make_outputs`."""
        return await self._client.make_outputs(
            self.id, outputs, fps=fps, idempotency_key=idempotency_key, timeout=timeout, **options
        )

    async def run_again(
        self,
        options: Options | Mapping[str, Any] | None = None,
        *,
        name: str = "",
        idempotency_key: str | None = None,
        timeout: float | None = None,
    ) -> AsyncRemoteJob:
        """Submit the same inputs with other options, without uploading them again; `name` defaults to this job's.

        Options that determine how tracks were read stay as they were. A film is tracked again with the same region, frames, grid and
        selection of points, unless `options` contain them. All other options start from their defaults.
        """
        return await self._client.submit(
            inputs_of=self.id, options=options, name=name, idempotency_key=idempotency_key, timeout=timeout
        )

    async def share(self, *, days: float = 7, timeout: float | None = None) -> Share:
        """Create a read-only link to the result: see `AsyncClient.share`."""
        return await self._client.share(self.id, days=days, timeout=timeout)

    async def delete(self, *, timeout: float | None = None) -> None:
        """Delete the job and its files from the service; `record` and `status` keep their last values."""
        await self._client.delete(self.id, timeout=timeout)


class AsyncResult(Reconstruction):
    """The result of a job; its methods download the files that are not local yet.

    It can be pickled: the pickle contains the record and, if they have been downloaded, the arrays and the report, but no client, so
    that what is unpickled downloads nothing and raises `BadArgument` instead. Copies share the client and the folder.
    """

    _linked: AsyncClient | None = None
    """None in a result that was unpickled."""

    def __init__(self, client: AsyncClient, job: Job, folder: Path | str | None) -> None:
        super().__init__(job, folder)
        self._linked = client

    @property
    def _client(self) -> AsyncClient:
        if self._linked is None:
            raise without_client(self.job)
        return self._linked

    async def load(self, *, timeout: float | None = None) -> Self:
        """Download the arrays and the report."""
        await self._client.download(self.job.id, self.folder, names=loaded(self.job), timeout=timeout)
        return self

    async def download(
        self,
        folder: Path | str,
        *,
        names: Iterable[str] | None = None,
        on_download: OnBytes | None = None,
        timeout: float | None = None,
    ) -> dict[str, Path]:
        """Download files into a folder: see `AsyncClient.download`."""
        return await self._client.download(self.job.id, folder, names=names, on_download=on_download, timeout=timeout)

    async def save_glb(self, path: Path | str, *, timeout: float | None = None) -> Path:
        """Save the animated mesh as glTF, for Blender or any glTF viewer."""
        held = await self._client.download(self.job.id, self.folder, names=[ANIMATION], timeout=timeout)
        return copied(held[ANIMATION], path)

"""What the synchronous client hands out: a job of the service, and its result."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Self

from pliant.client.multipart import OnBytes
from pliant.client.operations import OnJob
from pliant.client.result import ANIMATION, LOADED, Reconstruction, copied
from pliant.schemas.job import Job, Status

if TYPE_CHECKING:
    from pliant.client.client import Client


class RemoteJob:
    """A job of a service: its record as last seen, and the verbs that apply to it.

    Attributes
    ----------
    record : Job
        What the service said last; `refresh` asks again.
    """

    def __init__(self, client: Client, record: Job) -> None:
        self._client = client
        self.record = record

    def __repr__(self) -> str:
        return f"<RemoteJob {self.id} {self.status}>"

    @property
    def id(self) -> str:
        """The job's id."""
        return self.record.id

    @property
    def status(self) -> Status:
        """The status as last seen."""
        return self.record.status

    def refresh(self, *, timeout: float | None = None) -> Self:
        """Ask for the record again."""
        self.record = self._client.get(self.id, timeout=timeout).record
        return self

    def wait(
        self,
        *,
        on_progress: OnJob | None = None,
        folder: Path | str | None = None,
        load: bool = True,
        timeout: float | None = None,
    ) -> Result:
        """Wait until the job is over, and return its result: see `Client.wait`."""
        return self._client.wait(self.id, on_progress=on_progress, folder=folder, load=load, timeout=timeout)

    def events(self, *, timeout: float | None = None) -> Iterator[Job]:
        """Iterate over the record each time something about it is new; the last one is final."""
        for job in self._client.events(self.id, timeout=timeout):
            self.record = job
            yield job

    def log(self, *, timeout: float | None = None) -> str:
        """Return what its attempts have logged so far."""
        return self._client.log(self.id, timeout=timeout)

    def cancel(self, *, timeout: float | None = None) -> Self:
        """Ask for the job to be stopped."""
        self.record = self._client.cancel(self.id, timeout=timeout).record
        return self

    def retry(self, *, timeout: float | None = None) -> RemoteJob:
        """Queue a new job with the same inputs and options after this one failed or was cancelled; return the new one."""
        return self._client.retry(self.id, timeout=timeout)

    def delete(self, *, timeout: float | None = None) -> None:
        """Remove the job and its files."""
        self._client.delete(self.id, timeout=timeout)


class Result(Reconstruction):
    """The result of a job; files that are not here yet are fetched by its methods."""

    def __init__(self, client: Client, job: Job, folder: Path | str | None) -> None:
        super().__init__(job, folder)
        self._client = client

    def load(self, *, timeout: float | None = None) -> Self:
        """Fetch the arrays and the report."""
        self._client.download(self.job.id, self.folder, names=LOADED, timeout=timeout)
        return self

    def download(
        self,
        folder: Path | str,
        *,
        names: Iterable[str] | None = None,
        on_download: OnBytes | None = None,
        timeout: float | None = None,
    ) -> dict[str, Path]:
        """Fetch files into a folder: see `Client.download`."""
        return self._client.download(self.job.id, folder, names=names, on_download=on_download, timeout=timeout)

    def save_glb(self, path: Path | str, *, timeout: float | None = None) -> Path:
        """Save the animated mesh as glTF, for Blender or any viewer."""
        held = self._client.download(self.job.id, self.folder, names=[ANIMATION], timeout=timeout)
        return copied(held[ANIMATION], path)

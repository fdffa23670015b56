"""The synchronous client."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx
from numpy.typing import ArrayLike
from pliant.client import operations
from pliant.client.drive import iterate, run
from pliant.client.multipart import Inputs, OnBytes, Source
from pliant.client.operations import OnJob
from pliant.client.remote import RemoteJob, Result
from pliant.client.request import base_of, headers_of
from pliant.client.result import LOADED
from pliant.client.retry import Attempts, Contact, Policy
from pliant.schemas.job import Interpretation, Job, ServiceLimits, Status
from pliant.schemas.options import Options

DEFAULT_URL = "http://127.0.0.1:8000"


class Client:
    """A Pliant service, seen from here.

    Parameters
    ----------
    url : str
        Where `pliant up` listens.
    token : str, optional
        Sent as `Authorization: Bearer`.
    policy : Policy
        How patiently calls are repeated.
    transport : httpx.BaseTransport, optional
        Instead of the network, e.g. `pliant.client.testing.FakeService`.

    Examples
    --------
    ``Client().submit(points).wait(timeout=600).shapes`` is an array (F, P, 3).
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        token: str | None = None,
        policy: Policy = Policy(),  # noqa: B008 - frozen, so one for all is safe
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url = base_of(url)
        self._http = httpx.Client(base_url=self.url, headers=headers_of(token), transport=transport)
        self._policy = policy
        self._contact = Contact()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give up the connections."""
        self._http.close()

    def submit(
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
    ) -> RemoteJob:
        """Send tracks to be reconstructed, and return at once with the queued job.

        Parameters
        ----------
        tracks : array_like, mapping or path
            Points (F, P, 2) in pixels, NaN or masked where hidden; or a tracker's dictionary as it is (CoTracker, TAPIR, …);
            or the path of a file in any format the service reads.
        visible : array_like, optional
            Shape (F, P), bool or confidence in [0, 1]; with an array of tracks only.
        mesh : array_like, (rows, columns), path, optional
            Faces (T, 3) or (T, 4); or the size of a grid; or a mesh file; or ``"none"``. Vertex i is point i.
            Made from the tracks when not given.
        ground_truth : array_like or path, optional
            True shapes (F, P, 3): metrics come by themselves.
        rotations : array_like or path, optional
            Known cameras (F, 2, 3) or (F, 3, 3).
        options : Options or mapping, optional
            How to reconstruct; checked here before anything is sent.
        name : str
            Your own label.
        job_id : str, optional
            Your own id for the job; the same id with the same content is the same job.
        idempotency_key : str, optional
            Made up for each call when not given, so that a repetition inside the call never makes two jobs; give your own to have
            that across calls and restarts.
        webhook : str, optional
            Address that the service sends the finished job to; `pliant.client.webhooks.verified` checks what comes.
        webhook_secret : str, optional
            Signs that message, goes with `webhook`; `pliant.client.webhooks.new_secret` makes one.
        on_upload : callable, optional
            Told (bytes sent, bytes in all).
        timeout : float, optional
            Seconds for the whole call, repetitions included.

        Raises
        ------
        InvalidRequest
            The service refused the input; `problem` names the field, what was expected, and what it got.
        BadArgument, Refused, Unreachable, TimeIsUp
            See `pliant.client.errors`.
        """
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
            return RemoteJob(self, run(self._http, flow))

    def inspect(
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
        """Ask how inputs would be understood, without making a job of them.

        Parameters
        ----------
        tracks, visible, mesh, ground_truth, rotations, options, on_upload, timeout
            As for `submit`.

        Returns
        -------
        Interpretation
            Frames, points, layout, what is hidden, where the mesh comes from, and the evidence in sentences.

        Raises
        ------
        InvalidRequest
            What `submit` would be refused with; `problem.choices` lists the readings where several fit.
        """
        inputs = Inputs(tracks=tracks, visible=visible, mesh=mesh, ground_truth=ground_truth, rotations=rotations)
        with tempfile.TemporaryDirectory(prefix="pliant-inspect-") as folder:
            flow = operations.inspect(
                self._attempts(timeout, "the inspection"),
                inputs,
                folder=Path(folder),
                options=options,
                on_upload=on_upload,
            )
            return run(self._http, flow)

    def get(self, job: str, *, timeout: float | None = None) -> RemoteJob:
        """Return a job as it stands now."""
        return RemoteJob(self, run(self._http, operations.get(self._attempts(timeout), job)))

    def list(
        self, *, statuses: Iterable[Status | str] = (), page_size: int = 50, timeout: float | None = None
    ) -> Iterator[RemoteJob]:
        """Iterate over the jobs, newest first, fetching page after page as needed."""
        flow = operations.jobs(self._attempts(timeout), statuses=statuses, page_size=page_size)
        for job in iterate(self._http, flow):
            yield RemoteJob(self, job)

    def wait(
        self,
        job: str,
        *,
        on_progress: OnJob | None = None,
        folder: Path | str | None = None,
        load: bool = True,
        timeout: float | None = None,
    ) -> Result:
        """Wait until a job is over, and return its result.

        The service may be restarted meanwhile: the client goes on when it is back.

        Parameters
        ----------
        job : str
            The id.
        on_progress : callable, optional
            Told the job each time something about it is new.
        folder : path, optional
            Where files of the result are kept; a temporary folder, removed with the result, when not given.
        load : bool
            Fetch the arrays and the report at once.
        timeout : float, optional
            Seconds for everything. When they have passed, `TimeIsUp` is raised and the job goes on.

        Raises
        ------
        JobFailed, JobCancelled, TimeIsUp, Unreachable, Refused
            See `pliant.client.errors`.
        """
        attempts = self._attempts(timeout, f"job {job}")
        final = operations.succeeded(run(self._http, operations.wait(attempts, job, on_progress=on_progress)))
        result = Result(self, final, folder)
        if load:
            run(self._http, operations.fetch(attempts, final, result.folder, names=LOADED, on_download=None))
        return result

    def events(self, job: str, *, timeout: float | None = None) -> Iterator[Job]:
        """Iterate over a job's record each time something about it is new; the last one is final.

        The connection may break and the service be restarted meanwhile: the client goes on from the last event.
        """
        yield from iterate(self._http, operations.events(self._attempts(timeout, f"job {job}"), job))

    def result(
        self, job: str, *, folder: Path | str | None = None, load: bool = True, timeout: float | None = None
    ) -> Result:
        """Return the result of a job that has succeeded; unlike `wait`, refuses one that is not over."""
        attempts = self._attempts(timeout, f"the result of job {job}")
        final = operations.finished(run(self._http, operations.get(attempts, job)))
        result = Result(self, final, folder)
        if load:
            run(self._http, operations.fetch(attempts, final, result.folder, names=LOADED, on_download=None))
        return result

    def log(self, job: str, *, timeout: float | None = None) -> str:
        """Return what the job's attempts have logged so far, a line an entry."""
        return run(self._http, operations.log(self._attempts(timeout), job))

    def cancel(self, job: str, *, timeout: float | None = None) -> RemoteJob:
        """Ask for a job to be stopped; it may go on for a moment as `cancelling`."""
        return RemoteJob(self, run(self._http, operations.cancel(self._attempts(timeout), job)))

    def retry(self, job: str, *, timeout: float | None = None) -> RemoteJob:
        """Queue a new job with the inputs and options of one that failed or was cancelled, and return it."""
        return RemoteJob(self, run(self._http, operations.retry(self._attempts(timeout), job)))

    def delete(self, job: str, *, timeout: float | None = None) -> None:
        """Remove a job and its files."""
        run(self._http, operations.delete(self._attempts(timeout), job))

    def download(
        self,
        job: str,
        folder: Path | str,
        *,
        names: Iterable[str] | None = None,
        on_download: OnBytes | None = None,
        timeout: float | None = None,
    ) -> dict[str, Path]:
        """Fetch files of a job into a folder: streamed, resumed where interrupted, checked by SHA-256.

        Parameters
        ----------
        names : iterable of str, optional
            Which ones; all when not given.
        on_download : callable, optional
            Told (bytes of this file so far, bytes of this file).
        """
        attempts = self._attempts(timeout, f"the files of job {job}")
        record = run(self._http, operations.get(attempts, job))
        return run(self._http, operations.fetch(attempts, record, Path(folder), names=names, on_download=on_download))

    def options(self, *, timeout: float | None = None) -> dict[str, Any]:
        """Return the JSON Schema of the options: names, meanings, bounds, defaults."""
        return run(self._http, operations.document(self._attempts(timeout), "/v1/options"))

    def limits(self, *, timeout: float | None = None) -> ServiceLimits:
        """Return what the service accepts at most."""
        return run(self._http, operations.limits(self._attempts(timeout)))

    def ready(self, *, timeout: float | None = None) -> dict[str, Any]:
        """Return how the parts of the service are: queue, storage, workers."""
        return run(self._http, operations.document(self._attempts(timeout), "/readyz"))

    def _attempts(self, timeout: float | None, doing: str = "this call") -> Attempts:
        return Attempts(policy=self._policy, contact=self._contact, timeout=timeout, doing=doing)

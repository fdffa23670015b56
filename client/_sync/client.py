# Generated from client/_async/client.py by `make client`. Edit that file instead.
"""The client: one method per operation of the service."""

from __future__ import annotations

import math
import secrets
import tempfile
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, SupportsIndex
from urllib.parse import quote

from numpy.typing import ArrayLike
from pliant.client._sync import operations
from pliant.client._sync.batch import OnFailure, mapped
from pliant.client._sync.connection import Connection
from pliant.client._sync.events import follow
from pliant.client._sync.job import RemoteJob, Result
from pliant.client._sync.operations import OnJob
from pliant.client.call import Call
from pliant.client.errors import BadArgument, NotFound
from pliant.client.input_files import Region, Source, folder_to_fill
from pliant.client.multipart import Inputs, OnBytes, option_fields
from pliant.client.pauses import in_place
from pliant.client.requests import further, key_header, sharing, status_names
from pliant.client.result import finished, job_path, loaded, succeeded
from pliant.client.retry import SUBMISSION
from pliant.schemas.job import LARGEST_PAGE, Inspection, Job, JobPage, Priority, ServiceLimits, Status
from pliant.schemas.options import Options, Output
from pliant.schemas.shares import Share
from pydantic import RootModel

JSON = "application/json"
JSON_BODY = {"Content-Type": JSON}


class Document(RootModel[Any]):
    """JSON of any form."""


class Client(Connection):
    """A client of a Pliant service.

    Parameters
    ----------
    url : str, optional
        Address of the service; defaults to the environment variable `PLIANT_URL`, else to ``http://127.0.0.1:8000``.
    token : str, optional
        Bearer token; defaults to `PLIANT_TOKEN`. An empty variable counts as unset.
    headers : mapping of str to str, optional
        Sent with every request.
    verify : bool or ssl.SSLContext
        How TLS certificates are checked, as in httpx.
    retries : Retry
        How long and how often calls are retried.
    event_hooks : mapping of str to list of callables, optional
        Called with every ``"request"`` and ``"response"``, as in httpx.
    transport : httpx.BaseTransport, optional
        Replaces the network, e.g. by `pliant.service.testing.InMemoryService`.

    Examples
    --------
    ``result = (Client().submit(points)).wait(timeout=600)``; ``result.shapes`` is an array (F, P, 3).
    """

    def submit(
        self,
        tracks: Source | None = None,
        *,
        film: Path | str | None = None,
        region: Region | None = None,
        visible: ArrayLike | None = None,
        mesh: Source | tuple[int, int] | None = None,
        ground_truth: Source | None = None,
        rotations: Source | None = None,
        inputs_of: str | None = None,
        options: Options | Mapping[str, Any] | None = None,
        name: str = "",
        job_id: str | None = None,
        idempotency_key: str | None = None,
        webhook: str | None = None,
        webhook_secret: str | None = None,
        priority: Priority = "normal",
        on_upload: OnBytes | None = None,
        timeout: float | None = None,
    ) -> RemoteJob:
        """Submit tracks or a film for reconstruction and return the queued job.

        Parameters
        ----------
        tracks : array_like, mapping or path
            Points (F, P, 2) in pixels, NaN or masked where hidden; or the dictionary of a tracker (CoTracker, TAPIR, …);
            or the path of a file in any format that the service reads.
        film : path, optional
            A film instead of tracks: mp4, mov, webm, mkv, avi, animated GIF, or a zip or folder of
            pictures. The job tracks its points.
        region : path or array, optional
            Region to track in the film: a mask of the film's size, either a picture that is white inside, or an array (H, W) of
            bool, or of uint8 with 128 and above inside, or of 0 and 1. Without it and without the option `region_polygon`, the entire
            picture is tracked.
        visible : array_like, optional
            Shape (F, P), bool or confidence in [0, 1]; only with an array of tracks.
        mesh : array_like, (rows, columns), path, optional
            Faces (T, 3) or (T, 4), the size of a grid, a mesh file, or ``"none"``. Vertex i is point i. By default the
            service triangulates the tracks.
        ground_truth : array_like, mapping or path, optional
            True shapes (F, P, 3); the job then has error metrics.
        rotations : array_like, mapping or path, optional
            Known cameras (F, 2, 3) or (F, 3, 3), or ``{"rotations": …, "scales": …}`` with scales (F,) in pixels per unit of the shapes.
        inputs_of : str, optional
            Id of an earlier job whose inputs are reused with these options, instead of files.
        options : Options or mapping, optional
            Options of the reconstruction; validated before anything is sent.
        name : str
            Your own label.
        job_id : str, optional
            Your own id for the job. Submitting the same content under the same id again returns the same job.
        idempotency_key : str, optional
            Makes the submission idempotent across calls and restarts. By default each call uses a new key, so that its
            retries never create a second job.
        webhook : str, optional
            URL that receives the finished job; check messages with `pliant.client.webhooks.verified`.
        webhook_secret : str, optional
            Signs the webhook; create one with `pliant.client.webhooks.new_secret`.
        priority : str
            ``"high"``, ``"normal"`` or ``"low"``. Orders only your own waiting jobs; jobs of other owners are not overtaken.
        on_upload : callable, optional
            Called with (bytes sent, total bytes).
        timeout : float, optional
            Seconds for the whole call, retries included.

        Raises
        ------
        InvalidRequest
            The input is invalid; `problem` has the field, what was expected, and what was received.
        BadArgument, APIStatusError, Unreachable, WaitTimeout
            See `pliant.client.errors`.
        """
        inputs = Inputs(
            tracks=tracks, film=film, region=region, visible=visible, mesh=mesh, ground_truth=ground_truth, rotations=rotations,
            inputs_of=inputs_of,
        )  # fmt: skip
        with tempfile.TemporaryDirectory(prefix="pliant-submit-") as folder:
            job = operations.submit(
                self._exchange(timeout, SUBMISSION),
                inputs,
                folder=Path(folder),
                options=options,
                name=name,
                job_id=job_id,
                idempotency_key=idempotency_key,
                webhook=webhook,
                webhook_secret=webhook_secret,
                priority=priority,
                on_upload=on_upload,
            )
        return RemoteJob(self, job)

    def map(
        self,
        inputs: Iterable[Source | Mapping[str, Any]],
        *,
        at_once: int = 8,
        key: str | None = None,
        on_failure: OnFailure | None = None,
        load: bool = True,
        timeout: float | None = None,
        **submission: Any,
    ) -> Generator[Result, None, None]:
        """Submit many inputs and yield their results in the order of the inputs.

        Parameters
        ----------
        inputs : iterable
            Each as the first parameter of `submit`.
        at_once : int
            Maximum number of jobs that are submitted ahead.
        key : str, optional
            Makes the whole call idempotent: a call with the same key and inputs finds the jobs of the first call.
        on_failure : callable, optional
            Called with the index of an input and the error, if the input is refused or its job fails; the iteration continues.
            Without it the error is raised.
        load : bool
            Download the arrays and the report of each result.
        timeout : float, optional
            Seconds to wait for each result.
        **submission
            Further parameters of `submit`, the same for all: `mesh`, `options`, `priority`, …

        Raises
        ------
        PliantError
            An input was refused or its job failed, and there is no `on_failure`.
        """
        results = mapped(
            self, inputs, at_once=at_once, key=key, on_failure=on_failure, load=load, timeout=timeout, submission=submission
        )  # fmt: skip
        with closing(results):
            for result in results:
                yield result

    def inspect(
        self,
        tracks: Source | None = None,
        *,
        film: Path | str | None = None,
        region: Region | None = None,
        visible: ArrayLike | None = None,
        mesh: Source | tuple[int, int] | None = None,
        ground_truth: Source | None = None,
        rotations: Source | None = None,
        options: Options | Mapping[str, Any] | None = None,
        on_upload: OnBytes | None = None,
        timeout: float | None = None,
    ) -> Inspection:
        """Let the service read and validate inputs without creating a job.

        Parameters
        ----------
        tracks : array_like, mapping or path
            Points (F, P, 2), the dictionary of a tracker, or the path of a file, as for `submit`.
        film : path, optional
            A film instead of tracks. It is opened, not tracked.
        region : path or array, optional
            Region to track in the film, as for `submit`.
        visible : array_like, optional
            Shape (F, P), bool or confidence in [0, 1]; only with an array of tracks.
        mesh : array_like, (rows, columns), path, optional
            Faces (T, 3) or (T, 4), the size of a grid, a mesh file, or ``"none"``.
        ground_truth : array_like, mapping or path, optional
            True shapes (F, P, 3).
        rotations : array_like, mapping or path, optional
            Known cameras, as for `submit`.
        options : Options or mapping, optional
            Options that determine how the inputs are read.
        on_upload : callable, optional
            Called with (bytes sent, total bytes).
        timeout : float, optional
            Seconds for the whole call, retries included.

        Returns
        -------
        Inspection
            Frames, points, layout, hidden share, source of the mesh, and the evidence for each interpretation. `sample` has some
            points in some frames; `first_frame` is a film's first frame.

        Raises
        ------
        InvalidRequest
            As for `submit`; `problem.choices` lists the possible interpretations of an ambiguous file.
        """
        inputs = Inputs(
            tracks=tracks, film=film, region=region, visible=visible, mesh=mesh, ground_truth=ground_truth, rotations=rotations
        )  # fmt: skip
        exchange = self._exchange(timeout, "the inspection")
        with tempfile.TemporaryDirectory(prefix="pliant-inspect-") as folder:
            report = exchange.attempts.bounding(on_upload)
            form = in_place(partial(inputs.form, Path(folder), option_fields(options), report))
            call = Call(method="POST", path="/v1/inspect", form=form, changes_nothing=True)
            return exchange.record(call, Inspection)

    def get(self, job: str, *, timeout: float | None = None) -> RemoteJob:
        """Return a job with its current record."""
        return RemoteJob(self, self._exchange(timeout).record(Call(method="GET", path=job_path(job)), Job))

    def list(
        self,
        *,
        statuses: Iterable[Status | str] = (),
        limit: int | None = None,
        page_size: int = 50,
        timeout: float | None = None,
    ) -> Generator[RemoteJob, None, None]:
        """Iterate over the jobs, newest first; pages are requested as needed.

        Parameters
        ----------
        statuses : iterable of Status or str, or one of them
            Only jobs with one of these; by default all.
        limit : int, optional
            At most this many jobs; by default all.
        page_size : int
            Jobs per request, at most 200.
        timeout : float, optional
            Seconds for all requests together.

        Raises
        ------
        BadArgument
            There is no such status, the limit is negative, or the page size is not from 1 to 200.
        """
        exchange, wanted = self._exchange(timeout), status_names(statuses)
        if limit is not None and not (isinstance(limit, SupportsIndex) and limit >= 0):
            raise BadArgument(f"limit: expected at least 0 jobs, or None for all, got {limit!r}.")
        if not (isinstance(page_size, SupportsIndex) and 1 <= page_size <= LARGEST_PAGE):
            raise BadArgument(
                f"page_size: expected 1 to {LARGEST_PAGE} jobs, got {page_size!r}. Use limit for the number of jobs in all."
            )
        left = math.inf if limit is None else limit
        cursor: str | None = ""
        while cursor is not None and left > 0:
            params: dict[str, str | Sequence[str]] = {"limit": str(min(page_size, left)), "status": wanted}
            if cursor:
                params["cursor"] = cursor
            page = exchange.record(Call(method="GET", path="/v1/jobs", params=params), JobPage)
            for job in page.jobs:
                yield RemoteJob(self, job)
            cursor, left = page.next, left - len(page.jobs)

    def wait(
        self,
        job: str,
        *,
        on_progress: OnJob | None = None,
        folder: Path | str | None = None,
        load: bool = True,
        timeout: float | None = None,
    ) -> Result:
        """Wait until a job is finished and return its result. Survives restarts of the service.

        Parameters
        ----------
        job : str
            The id.
        on_progress : callable, optional
            Called with the job each time its record changes.
        folder : path, optional
            Folder for the files of the result; by default a temporary folder that is removed with the result object.
        load : bool
            Download the arrays and the report.
        timeout : float, optional
            Seconds for the whole call, after which `WaitTimeout` is raised. The job continues.

        Raises
        ------
        JobFailed, JobCancelled, WaitTimeout, Unreachable, APIStatusError, BadArgument
            See `pliant.client.errors`.
        """
        exchange = self._exchange(timeout, f"the wait for job {job}")
        if folder is not None:
            folder_to_fill(folder)  # now, and not after the job has run for minutes
        record = succeeded(operations.wait(exchange, job, on_progress=on_progress))
        result = Result(self, record, folder)
        if load:
            operations.fetch(exchange, record, result.folder, names=loaded(record), on_download=None)
        return result

    def events(self, job: str, *, timeout: float | None = None) -> Generator[Job, None, None]:
        """Yield a job's record each time it changes; the last one has a final status.

        If the connection breaks or the service restarts, the stream resumes after the last event.
        """
        exchange = self._exchange(timeout, f"the events of job {job}")
        with closing(follow(exchange, job_path(job))) as changes:
            for now in changes:
                yield now

    def result(
        self, job: str, *, folder: Path | str | None = None, load: bool = True, timeout: float | None = None
    ) -> Result:
        """Return the result of a job that has succeeded; unlike `wait`, raises `NotAllowedNow` if it is not finished."""
        exchange = self._exchange(timeout, f"the download of job {job}")
        record = finished(exchange.record(Call(method="GET", path=job_path(job)), Job))
        result = Result(self, record, folder)
        if load:
            operations.fetch(exchange, record, result.folder, names=loaded(record), on_download=None)
        return result

    def log(self, job: str, *, timeout: float | None = None) -> str:
        """Return a job's log so far, one entry per line."""
        _, body = self._exchange(timeout).answer(Call(method="GET", path=f"{job_path(job)}/log"))
        return body.decode("utf-8", "replace")

    def cancel(self, job: str, *, timeout: float | None = None) -> RemoteJob:
        """Request cancellation of a job; a running job has the status `cancelling` until it stops."""
        call = Call(method="POST", path=f"{job_path(job)}/cancel", changes_nothing=True)
        return RemoteJob(self, self._exchange(timeout).record(call, Job))

    def retry(self, job: str, *, idempotency_key: str | None = None, timeout: float | None = None) -> RemoteJob:
        """Queue and return a new job with the inputs and options of a failed or cancelled one; `idempotency_key` as in `submit`."""
        headers = key_header(secrets.token_urlsafe(16) if idempotency_key is None else idempotency_key)
        call = Call(method="POST", path=f"{job_path(job)}/retry", headers=headers)
        return RemoteJob(self, self._exchange(timeout, SUBMISSION).record(call, Job))

    def make_outputs(
        self,
        job: str,
        outputs: Iterable[Output] | str,
        *,
        fps: float | None = None,
        idempotency_key: str | None = None,
        timeout: float | None = None,
        **options: Any,
    ) -> RemoteJob:
        """Queue and return a job that writes further files from a finished job's result, without solving again.

        Parameters
        ----------
        job : str
            The id of a job that has succeeded.
        outputs : iterable of str, or str
            Any of ``glb``, ``ply``, ``obj``, ``usd``, ``abc``, ``mdd``, ``mat`` and ``csv``; a string is split at commas.
        fps : float, optional
            Frames per second of the written animation; by default the job's.
        idempotency_key : str, optional
            By default the same request returns the same job, unless that one failed or was cancelled.
        timeout : float, optional
            Seconds for the whole call, retries included.
        **options
            ``normals``, ``colours``, ``axes``, ``glb_quantized`` and ``glb_motion``; by default the job's.

        Raises
        ------
        BadArgument
            An output or an option is unknown or invalid; nothing was sent.
        InvalidRequest, NotAllowedNow, NotFound
            The service refuses the request; see `pliant.client.errors`.
        """
        request = further(outputs, {**options, **({} if fps is None else {"fps": fps})})
        headers = JSON_BODY | ({} if idempotency_key is None else key_header(idempotency_key))
        body = request.model_dump_json(exclude_unset=True).encode()
        call = Call(method="POST", path=f"{job_path(job)}/outputs", headers=headers, content=body, changes_nothing=True)
        return RemoteJob(self, self._exchange(timeout, "the request for further files").record(call, Job))

    def share(self, job: str, *, days: float = 7, timeout: float | None = None) -> Share:
        """Create a read-only link to a finished job's result, valid until it expires or is revoked.

        ``f"{client.url}/{share.path}"`` is the address to send; it contains the secret, which the service does not store.

        Parameters
        ----------
        job : str
            The id of a job that has succeeded.
        days : float
            Lifetime of the link, from one minute to 366 days.
        timeout : float, optional
            Seconds for the whole call, retries included.
        """
        body = sharing(days).model_dump_json(exclude_unset=True).encode()
        call = Call(method="POST", path=f"{job_path(job)}/shares", headers=JSON_BODY, content=body)
        return self._exchange(timeout).record(call, Share)

    def shares(self, job: str, *, timeout: float | None = None) -> Sequence[Share]:
        """Return the valid share links of a job, without their secrets."""
        shares: Sequence[Any] = self._document(f"{job_path(job)}/shares", timeout)
        return [Share.model_validate(each) for each in shares]

    def revoke_share(self, job: str, share: str, *, timeout: float | None = None) -> None:
        """Revoke a share link by its id."""
        self._remove(f"{job_path(job)}/shares/{quote(share, safe='')}", timeout)

    def delete(self, job: str, *, timeout: float | None = None) -> None:
        """Delete a finished job and its files."""
        self._remove(job_path(job), timeout)

    def download(
        self,
        job: str,
        folder: Path | str,
        *,
        names: Iterable[str] | None = None,
        on_download: OnBytes | None = None,
        timeout: float | None = None,
    ) -> dict[str, Path]:
        """Download files of a job into a folder: streamed, resumed after interruptions, checked by SHA-256.

        Parameters
        ----------
        job : str
            The id of a job that has succeeded.
        folder : path
            Where the files are written; it is created if it does not exist.
        names : iterable of str, or str, optional
            Names of the files, or of one file; by default all.
        on_download : callable, optional
            Called with (bytes of this file so far, total bytes of this file).
        timeout : float, optional
            Seconds for the whole call, retries included.

        Returns
        -------
        dict of str to Path
            The path of each file, by its name.
        """
        exchange = self._exchange(timeout, f"the download of job {job}")
        record = exchange.record(Call(method="GET", path=job_path(job)), Job)
        return operations.fetch(exchange, record, folder_to_fill(folder), names=names, on_download=on_download)

    def options(self, *, timeout: float | None = None) -> dict[str, Any]:
        """Return the JSON Schema of the options: names, meanings, bounds, defaults."""
        schema: dict[str, Any] = self._document("/v1/options", timeout)
        return schema

    def limits(self, *, timeout: float | None = None) -> ServiceLimits:
        """Return the service's limits."""
        return self._exchange(timeout).record(Call(method="GET", path="/v1/limits"), ServiceLimits)

    def ready(self, *, timeout: float | None = None) -> dict[str, Any]:
        """Return the state of each part of the service: queue, storage, workers."""
        parts: dict[str, Any] = self._document("/readyz", timeout)
        return parts

    def _remove(self, path: str, timeout: float | None) -> None:
        exchange = self._exchange(timeout)
        try:
            exchange.answer(Call(method="DELETE", path=path))
        except NotFound:
            if not exchange.attempts.uncertain:  # otherwise an earlier attempt removed it, and the response was lost
                raise

    def _document(self, path: str, timeout: float | None) -> Any:
        call = Call(method="GET", path=path, headers={"Accept": JSON})
        return (self._exchange(timeout).record(call, Document)).root

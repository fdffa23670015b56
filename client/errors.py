"""Errors of the SDK.

    PliantError
    ├── Unreachable              no answer from the service, despite retries
    ├── WaitTimeout              the caller's `timeout` passed; the job continues
    ├── UnexpectedAnswer         the answer is not from a Pliant service
    ├── CorruptDownload          a file was downloaded twice and its SHA-256 is wrong
    ├── BadArgument              an argument is invalid; nothing was sent
    ├── NotLoaded                a result's arrays were read before they were downloaded
    ├── InvalidSignature         a webhook message is forged, altered or too old
    ├── APIStatusError           the service answered with an error: problem+json with code and detail
    │   ├── InvalidRequest       400, 413, 415, 422: the input is invalid; see `problem`
    │   ├── NotAuthorized        401, 403: the token is missing or lacks a scope
    │   ├── NotFound             404, 410: no such job or file, or it was deleted
    │   ├── NotAllowedNow        409: the job's status does not allow the operation
    │   ├── TooManyRequests      429: rate or queue limit reached; see `retry_after`
    │   └── ServiceFailed        5xx: an error in the service
    └── JobEnded                 the job has ended without a result
        ├── JobFailed            `job.error` gives the reason
        └── JobCancelled         the job was cancelled

Every message is a complete sentence, the service's own where it sent one.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http import HTTPStatus

from pliant.schemas.invalid import Picklable
from pliant.schemas.job import Job, Problem
from pydantic import ValidationError

PROBLEM_TYPE = "application/problem+json"


class PliantError(Picklable):
    """Base of all errors of the SDK; each has a `code`, a stable machine-readable name."""


class Unreachable(PliantError):
    """No answer from the service, despite retries."""

    code = "unreachable"
    """Stable machine-readable name."""


class WaitTimeout(PliantError, TimeoutError):
    """The caller's `timeout` passed. Nothing was cancelled: the job continues and can be waited for again."""

    code = "wait_timeout"
    """Stable machine-readable name."""


class UnexpectedAnswer(PliantError):
    """The answer is not from a Pliant service: a proxy's error page or redirect, for example.

    Attributes
    ----------
    status : int or None
        The HTTP status code of an error or redirect.
    """

    code = "unexpected_answer"
    """Stable machine-readable name."""

    def __init__(self, sentence: str, *, status: int | None = None) -> None:
        super().__init__(sentence)
        self.status = status


class CorruptDownload(PliantError):
    """A file was downloaded twice and does not have the SHA-256 of the job's record."""

    code = "corrupt_download"
    """Stable machine-readable name."""


class BadArgument(PliantError, ValueError):
    """An argument is invalid; nothing was sent.

    Attributes
    ----------
    code : str
        Stable machine-readable name: ``"invalid_argument"``, or ``"invalid_option"`` for the options of a job.
    """

    def __init__(self, sentence: str, *, code: str = "invalid_argument") -> None:
        super().__init__(sentence)
        self.code = code


class NotLoaded(PliantError):
    """A result's arrays were read before they were downloaded."""

    code = "not_loaded"
    """Stable machine-readable name."""


class InvalidSignature(PliantError):
    """A webhook message is forged, altered or too old."""

    code = "invalid_signature"
    """Stable machine-readable name."""


class APIStatusError(PliantError):
    """The service answered with an error status.

    Attributes
    ----------
    problem : Problem
        The complete document: `code`, `detail` and, where they apply, `field`, `expected`, `got`, `hint`, `choices`.
    retry_after : float or None
        Seconds to wait, from the Retry-After header.
    """

    def __init__(self, problem: Problem, *, retry_after: float | None = None) -> None:
        super().__init__(problem)
        self.problem = problem
        self.retry_after = retry_after

    def __str__(self) -> str:
        return self.problem.detail

    @property
    def code(self) -> str:
        """Stable machine-readable name, e.g. ``"wrong_shape"``."""
        return self.problem.code

    @property
    def status(self) -> int:
        """The HTTP status code."""
        return self.problem.status


class InvalidRequest(APIStatusError):
    """The input is invalid (400, 413, 415, 422)."""


class NotAuthorized(APIStatusError):
    """The token is missing or lacks a scope (401, 403)."""


class NotFound(APIStatusError):
    """No such job or file, or it was deleted (404, 410)."""


class NotAllowedNow(APIStatusError):
    """The job's status does not allow the operation (409)."""


class TooManyRequests(APIStatusError):
    """Rate or queue limit reached (429); see `retry_after`."""


class ServiceFailed(APIStatusError):
    """An error in the service (5xx)."""


class JobEnded(PliantError):
    """The job has ended without a result.

    Attributes
    ----------
    job : Job
        The final record.
    """

    def __init__(self, job: Job) -> None:
        super().__init__(job)
        self.job = job

    def __str__(self) -> str:
        return _ending(self.job)


class JobFailed(JobEnded):
    """The job failed; `job.error` gives the reason."""

    @property
    def code(self) -> str:
        """Stable machine-readable name of the error, e.g. ``"worker_lost"``."""
        return self.job.error.code if self.job.error is not None else "unknown"


class JobCancelled(JobEnded):
    """The job was cancelled."""

    code = "job_cancelled"
    """Stable machine-readable name."""


BY_STATUS: Mapping[int, type[APIStatusError]] = {
    HTTPStatus.BAD_REQUEST: InvalidRequest,
    HTTPStatus.UNAUTHORIZED: NotAuthorized,
    HTTPStatus.FORBIDDEN: NotAuthorized,
    HTTPStatus.NOT_FOUND: NotFound,
    HTTPStatus.CONFLICT: NotAllowedNow,
    HTTPStatus.GONE: NotFound,
    413: InvalidRequest,  # its name in HTTPStatus changed with Python 3.13
    HTTPStatus.UNSUPPORTED_MEDIA_TYPE: InvalidRequest,
    422: InvalidRequest,  # likewise
    HTTPStatus.TOO_MANY_REQUESTS: TooManyRequests,
}


def error_from(status: int, headers: Mapping[str, str], body: bytes) -> APIStatusError | UnexpectedAnswer:
    """Return the exception for a response with status 300 or above."""
    media_type = headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != PROBLEM_TYPE:
        start = body[:200].decode("utf-8", "replace").strip()
        elsewhere = f" and a redirect to {headers['location'][:200]}" if "location" in headers else ""
        return UnexpectedAnswer(
            f"Expected {PROBLEM_TYPE} with status {status}, got {media_type or 'no content type'}: {start!r}{elsewhere}. "
            "Check that the address is a Pliant service and that no proxy answers instead.",
            status=status,
        )
    try:
        problem = Problem.model_validate_json(body)
    except ValidationError as fault:
        return UnexpectedAnswer(f"The problem document with status {status} cannot be read: {fault}", status=status)
    kind = BY_STATUS.get(status, ServiceFailed if status >= 500 else APIStatusError)
    return kind(problem, retry_after=seconds_of(headers.get("retry-after")))


def seconds_of(retry_after: str | None) -> float | None:
    """Read a Retry-After header, seconds or an HTTP date; an invalid one counts as absent."""
    if retry_after is None:
        return None
    if retry_after.strip().isdecimal():
        return float(retry_after)
    try:
        moment = parsedate_to_datetime(retry_after)
    except ValueError:
        return None
    if moment.tzinfo is None:  # "-0000": the time is UTC, its origin unknown
        moment = moment.replace(tzinfo=UTC)
    return max(0.0, (moment - datetime.now(UTC)).total_seconds())


def _ending(job: Job) -> str:
    label = f"Job {job.id}" + (f" ({job.name})" if job.name != "" else "")
    if job.error is not None:
        return f"{label} {job.status}: {job.error.detail}"
    return f"{label} was {job.status}." if job.sentence is None else f"{label} was {job.status}: {job.sentence}"

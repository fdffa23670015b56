"""Errors of the SDK.

    PliantError                  base: catch this one
    ├── Unreachable              no answer from the service, however often it was asked
    ├── TimeIsUp                 the caller's own `timeout` passed; the job, if there is one, goes on
    ├── UnexpectedAnswer         something answered, but it does not speak Pliant
    ├── CorruptDownload          a file did not have its SHA-256, twice
    ├── BadArgument              what was handed to the SDK cannot be sent
    ├── NotLoaded                a result's arrays were asked for before they were fetched
    ├── NotGenuine               a webhook's message is not from the service, or too old
    ├── Refused                  the service said no: problem+json with code and sentence
    │   ├── InvalidRequest       400, 413, 415, 422: the input is at fault; `field`, `expected`, `got` say how
    │   ├── NotAuthorized        401, 403: no token, or not one that may do this
    │   ├── NotFound             404, 410: no such job or file (any more)
    │   ├── NotAllowedNow        409: the job's status does not allow it
    │   ├── TooManyRequests      429: slow down; `retry_after` says how long
    │   └── ServiceFailed        5xx: the service is at fault
    └── JobEnded                 the job is over and there is no result
        ├── JobFailed            `job.error` says why
        └── JobCancelled         somebody cancelled it

The message of every error is a whole sentence, the server's own where it gave one.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http import HTTPStatus

from pliant.schemas.job import Job, Problem
from pydantic import ValidationError

PROBLEM_TYPE = "application/problem+json"


class PliantError(Exception):
    """Something went wrong between the caller and the result."""


class Unreachable(PliantError):
    """No answer from the service, however often it was asked."""


class TimeIsUp(PliantError, TimeoutError):
    """The caller's own `timeout` passed. Nothing was cancelled: a job goes on and can be waited for again."""


class UnexpectedAnswer(PliantError):
    """Something answered that does not speak Pliant: a proxy's error page, or another service."""


class CorruptDownload(PliantError):
    """A file did not have the SHA-256 its job names, although it was fetched twice."""


class BadArgument(PliantError, ValueError):
    """What was handed to the SDK cannot be sent."""


class NotLoaded(PliantError):
    """A result's arrays were asked for before they were fetched."""


class NotGenuine(PliantError):
    """A webhook's message is not from the service, was changed, or is too old."""


class Refused(PliantError):
    """The service said no.

    Attributes
    ----------
    problem : Problem
        The whole answer: `code`, `detail`, and where they apply `field`, `expected`, `got`, `hint`, `choices`.
    retry_after : float or None
        Seconds the service asked to wait.
    """

    def __init__(self, problem: Problem, *, retry_after: float | None = None) -> None:
        super().__init__(problem.detail)
        self.problem = problem
        self.retry_after = retry_after

    @property
    def code(self) -> str:
        """Stable machine-readable name, e.g. ``"wrong_shape"``."""
        return self.problem.code

    @property
    def status(self) -> int:
        """The HTTP status code."""
        return self.problem.status


class InvalidRequest(Refused):
    """The input is at fault (400, 413, 415, 422)."""


class NotAuthorized(Refused):
    """No token, or not one that may do this (401, 403)."""


class NotFound(Refused):
    """No such job or file, or not any more (404, 410)."""


class NotAllowedNow(Refused):
    """The job's status does not allow it (409)."""


class TooManyRequests(Refused):
    """Too much at once (429); `retry_after` says how long to wait."""


class ServiceFailed(Refused):
    """The service is at fault (5xx)."""


class JobEnded(PliantError):
    """The job is over and there is no result.

    Attributes
    ----------
    job : Job
        The final record.
    """

    def __init__(self, job: Job) -> None:
        super().__init__(_ending(job))
        self.job = job


class JobFailed(JobEnded):
    """The job failed; `job.error` says why."""

    @property
    def code(self) -> str:
        """Stable machine-readable name of the fault, e.g. ``"worker_lost"``."""
        return self.job.error.code if self.job.error is not None else "unknown"


class JobCancelled(JobEnded):
    """Somebody cancelled the job."""


BY_STATUS: Mapping[int, type[Refused]] = {
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


def error_from(status: int, headers: Mapping[str, str], body: bytes) -> Refused | UnexpectedAnswer:
    """Make the exception that an answer of 400 or more stands for; it is returned, not raised."""
    media_type = headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != PROBLEM_TYPE:
        start = body[:200].decode("utf-8", "replace").strip()
        return UnexpectedAnswer(
            f"Expected {PROBLEM_TYPE} with status {status}, got {media_type or 'no content type'}: {start!r}. "
            "Check that the address is a Pliant service and that no proxy answers in its place."
        )
    try:
        problem = Problem.model_validate_json(body)
    except ValidationError as fault:
        return UnexpectedAnswer(f"Status {status} with a problem document that cannot be read: {fault}")
    kind = BY_STATUS.get(status, ServiceFailed if status >= 500 else Refused)
    return kind(problem, retry_after=seconds_of(headers.get("retry-after")))


def seconds_of(retry_after: str | None, *, now: datetime | None = None) -> float | None:
    """Read a Retry-After header: seconds, or an HTTP date; nonsense counts as not given."""
    if retry_after is None:
        return None
    if retry_after.strip().isdigit():
        return float(retry_after)
    try:
        moment = parsedate_to_datetime(retry_after)
    except ValueError:
        return None
    if moment.tzinfo is None:  # "-0000": the time is UTC, its origin unknown
        moment = moment.replace(tzinfo=UTC)
    return max(0.0, (moment - (now if now is not None else datetime.now(UTC))).total_seconds())


def _ending(job: Job) -> str:
    label = f"Job {job.id}" + (f" ({job.name})" if job.name != "" else "")
    if job.error is not None:
        return f"{label} {job.status}: {job.error.detail}"
    return f"{label} was {job.status}." if job.sentence is None else f"{label} was {job.status}: {job.sentence}"

"""The SDK: clients of a Pliant service, synchronous and asynchronous.

Start with ``from pliant.client import Client``. Names are imported on first use, so importing this package is cheap.
"""

if __name__ != "pliant.client":
    raise ImportError(f"import this folder as pliant.client, not as {__name__!r}: install it with pip install -e .")

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.client._async.client import AsyncClient
    from pliant.client._async.job import AsyncRemoteJob, AsyncResult
    from pliant.client._sync.client import Client
    from pliant.client._sync.job import RemoteJob, Result
    from pliant.client.errors import (
        APIStatusError,
        BadArgument,
        CorruptDownload,
        InvalidRequest,
        InvalidSignature,
        JobCancelled,
        JobEnded,
        JobFailed,
        NotAllowedNow,
        NotAuthorized,
        NotFound,
        NotLoaded,
        PliantError,
        ServiceFailed,
        TooManyRequests,
        UnexpectedAnswer,
        Unreachable,
        WaitTimeout,
    )
    from pliant.client.retry import Retry
    from pliant.schemas.job import Artifact, Inspection, Interpretation, Job, Problem, Progress, ServiceLimits, Status
    from pliant.schemas.options import Options
    from pliant.schemas.shares import Share

_HOMES = {
    "errors": (
        "APIStatusError", "BadArgument", "CorruptDownload", "InvalidRequest", "InvalidSignature", "JobCancelled", "JobEnded",
        "JobFailed", "NotAllowedNow", "NotAuthorized", "NotFound", "NotLoaded", "PliantError", "ServiceFailed",
        "TooManyRequests", "UnexpectedAnswer", "Unreachable", "WaitTimeout",
    ),
    "retry": ("Retry",),
    "_async.client": ("AsyncClient",),
    "_async.job": ("AsyncRemoteJob", "AsyncResult"),
    "_sync.client": ("Client",),
    "_sync.job": ("RemoteJob", "Result"),
}  # fmt: skip
_HOME_OF = {name: f"pliant.client.{module}" for module, names in _HOMES.items() for name in names} | {
    "Options": "pliant.schemas.options",
    "Share": "pliant.schemas.shares",
    **dict.fromkeys(
        ("Artifact", "Inspection", "Interpretation", "Job", "Problem", "Progress", "ServiceLimits", "Status"),
        "pliant.schemas.job",
    ),
}

__all__ = [  # noqa: RUF022 - by use, not by alphabet
    "Client", "RemoteJob", "Result", "AsyncClient", "AsyncRemoteJob", "AsyncResult", "Retry", "Options",
    "Artifact", "Inspection", "Interpretation", "Job", "Problem", "Progress", "ServiceLimits", "Share", "Status",
    "PliantError", "Unreachable", "WaitTimeout", "UnexpectedAnswer", "CorruptDownload", "BadArgument", "NotLoaded",
    "InvalidSignature", "APIStatusError", "InvalidRequest", "NotAuthorized", "NotFound", "NotAllowedNow", "TooManyRequests",
    "ServiceFailed", "JobEnded", "JobFailed", "JobCancelled",
]  # fmt: skip


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'pliant.client' has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

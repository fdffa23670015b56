"""The wire contract, the SDK and the command line.

``from pliant.client import Client`` is the usual beginning. Names are looked up when first used, so that whoever needs only
the wire contract (`pliant.schemas.job`) does not load NumPy and httpx.
"""

if __name__ != "pliant.client":
    raise ImportError(f"import this folder as pliant.client, not as {__name__!r}: install it with pip install -e .")

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.client.async_client import AsyncClient
    from pliant.client.async_remote import AsyncRemoteJob, AsyncResult
    from pliant.client.client import Client
    from pliant.client.errors import (
        BadArgument,
        CorruptDownload,
        InvalidRequest,
        JobCancelled,
        JobEnded,
        JobFailed,
        NotAllowedNow,
        NotAuthorized,
        NotFound,
        NotGenuine,
        NotLoaded,
        PliantError,
        Refused,
        ServiceFailed,
        TimeIsUp,
        TooManyRequests,
        UnexpectedAnswer,
        Unreachable,
    )
    from pliant.client.remote import RemoteJob, Result
    from pliant.client.retry import Policy
    from pliant.schemas.job import (
        Artifact,
        Interpretation,
        Job,
        Problem,
        Progress,
        ServiceLimits,
        Status,
    )
    from pliant.schemas.options import Options

_HOMES = {
    "errors": (
        "BadArgument", "CorruptDownload", "InvalidRequest", "JobCancelled", "JobEnded", "JobFailed", "NotAllowedNow",
        "NotAuthorized", "NotFound", "NotGenuine", "NotLoaded", "PliantError", "Refused", "ServiceFailed", "TimeIsUp", "TooManyRequests",
        "UnexpectedAnswer", "Unreachable",
    ),
    "retry": ("Policy",),
    "async_client": ("AsyncClient",),
    "async_remote": ("AsyncRemoteJob", "AsyncResult"),
    "client": ("Client",),
    "remote": ("RemoteJob", "Result"),
}  # fmt: skip
_HOME_OF = {name: f"pliant.client.{module}" for module, names in _HOMES.items() for name in names} | {
    "Options": "pliant.schemas.options",
    **dict.fromkeys(
        ("Artifact", "Interpretation", "Job", "Problem", "Progress", "ServiceLimits", "Status"), "pliant.schemas.job"
    ),
}

__all__ = [  # noqa: RUF022 - by use, not by alphabet
    "Client", "RemoteJob", "Result", "AsyncClient", "AsyncRemoteJob", "AsyncResult", "Policy", "Options",
    "Artifact", "Interpretation", "Job", "Problem", "Progress", "ServiceLimits", "Status",
    "PliantError", "Unreachable", "TimeIsUp", "UnexpectedAnswer", "CorruptDownload", "BadArgument", "NotLoaded", "NotGenuine",
    "Refused", "InvalidRequest", "NotAuthorized", "NotFound", "NotAllowedNow", "TooManyRequests", "ServiceFailed",
    "JobEnded", "JobFailed", "JobCancelled",
]  # fmt: skip


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'pliant.client' has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

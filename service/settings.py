"""Settings of the service: one frozen record, read from the environment, a `.env` file or secret files, never on import."""

from __future__ import annotations

import ipaddress
import re
from typing import Annotated, Literal

from pliant.schemas.job import HEARTBEAT_SECONDS
from pliant.worker.environment import read
from pliant.worker.logs import LogFormat, LogLevel
from pydantic import AfterValidator, BeforeValidator, Field
from pydantic.dataclasses import dataclass

MB = 2**20

USUAL_RATE = 1200
"""Default rate limit: 1200 requests per minute, i.e. 20 per second on average, all of which may arrive at once."""

Auth = Literal["auto", "required", "off"]


def _split(given: object) -> object:
    """Read a comma-separated list."""
    return tuple(part.strip() for part in given.split(",") if part.strip()) if isinstance(given, str) else given


Listed = Annotated[tuple[str, ...], BeforeValidator(_split), Field(description="names, separated by commas")]

_ORIGIN = re.compile(r"https?://[^/?#@]+")


def _origins(given: tuple[str, ...]) -> tuple[str, ...]:
    """Write origins as browsers send them: in lower case, without a slash at the end."""
    origins = tuple(each.removesuffix("/").lower() for each in given)
    for each in origins:
        if _ORIGIN.fullmatch(each) is None:
            raise ValueError(f"{each} is not an origin")
    return origins


Origins = Annotated[
    Listed, AfterValidator(_origins), Field(description="origins such as https://example.org, separated by commas")
]

_HOST = re.compile(r"(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::\d{1,5})?")


def _hosts(given: tuple[str, ...]) -> tuple[str, ...]:
    for each in given:
        if _HOST.fullmatch(each) is None:
            raise ValueError(f"{each} is not the value of a Host header")
    return given


Hosts = Annotated[
    Listed,
    AfterValidator(_hosts),
    Field(description="names such as pliant.example.org, without scheme and path, separated by commas"),
]


def _proxies(given: tuple[str, ...]) -> tuple[str, ...]:
    """Check what Uvicorn does not: it takes anything else for the name of a proxy, which no connection has."""
    for each in given if given != ("*",) else ():
        ipaddress.ip_network(each)
    return given


Proxies = Annotated[
    Listed,
    AfterValidator(_proxies),
    Field(description="addresses or networks such as 10.0.0.0/8, separated by commas, or * alone"),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceSettings:
    """Settings of the service. A field NAME is read from the variable PLIANT_NAME."""

    host: str = "127.0.0.1"
    """Address to bind."""
    port: int = Field(default=8000, ge=0, le=65535)
    """TCP port to bind; 0 takes a free one."""
    max_body_mb: float = Field(default=2048.0, gt=0, le=2**20)
    """Largest body of one request, in MiB."""
    max_text_bytes: int = Field(default=1 * MB, ge=1)
    """Largest text field of a form, or whole JSON body, in bytes."""
    max_queued: int = Field(default=1000, ge=0, le=10**7)
    """Maximum number of queued jobs per token, unless the token has its own limit; 0: no limit. With tokens off, the limit
    applies to all jobs together."""
    requests_per_minute: int | None = Field(default=None, ge=0, le=10**7)
    """Maximum number of requests per minute per token, or per address with tokens off; 0: no limit; None: 1200 if the service is
    not on the loopback address or requires tokens, else no limit."""
    parsers: int = Field(default=2, ge=1, le=64)
    """Number of bodies that are parsed at once; each may take the memory of a complete input."""
    stall_seconds: float = Field(default=60.0, gt=0)
    """Seconds without a byte of an unfinished body after which the request is refused."""
    max_wait_seconds: int = Field(default=60, ge=0)
    """Longest wait that `Prefer: wait=n` can request, in seconds."""
    heartbeat_seconds: float = Field(default=HEARTBEAT_SECONDS, gt=0)
    """Seconds without an event after which an event stream sends a comment line."""
    allowed_hosts: Hosts = ()
    """Accepted values of the Host header, separated by commas; ports do not count. Empty: the names of the loopback address if
    the service is bound to it, else any. `/healthz`, `/readyz` and `/metrics` accept every host."""
    auth: Auth = "auto"
    """Whether a request needs a token: `required`, `off`, or `auto`, which is off on the loopback address and required on any
    other."""
    cors_origins: Origins = ()
    """Origins whose pages may call the service, separated by commas; empty: none."""
    trusted_proxies: Proxies = ()
    """Addresses or networks of proxies whose `X-Forwarded-For` is trusted, separated by commas; `*` for any. Empty: none,
    because any user of the machine could otherwise choose the address to which rate limits apply."""
    presigned_redirects: bool = True
    """Whether downloads that accept it (`?redirect=true`) are redirected to a presigned S3 URL, valid for five minutes. Disable it
    if clients cannot reach the object store. No effect without S3."""
    log_level: LogLevel = "info"
    """Lowest level that is logged."""
    log_format: LogFormat = "console"
    """`console` for people, `json` for one JSON object per line."""

    @classmethod
    def from_environment(cls) -> ServiceSettings:
        """Read the `PLIANT_…` variables, `.env` and the secret files: see `pliant.worker.environment.read`."""
        return read(cls)

    @property
    def max_body_bytes(self) -> int:
        """Largest body of one request, in bytes."""
        return int(self.max_body_mb * MB)

    @property
    def asks_for_tokens(self) -> bool:
        """True if a request needs a token."""
        return self.auth == "required" or (self.auth == "auto" and not self.loopback)

    def rate_of(self, own: int | None) -> int:
        """Return the requests per minute that a token with its own limit `own` may send; 0 means no limit."""
        if own is not None:
            return own
        if self.requests_per_minute is not None:
            return self.requests_per_minute
        return USUAL_RATE if self.asks_for_tokens or not self.loopback else 0

    @property
    def loopback(self) -> bool:
        """True if only this machine can reach the service."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

"""Settings of the service: one frozen record, read from the environment, a `.env` file or secret files, never on import."""

from __future__ import annotations

import ipaddress
from typing import Annotated, Literal

from pliant.worker.environment import read
from pliant.worker.logs import LogFormat, LogLevel
from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

MB = 2**20

USUAL_RATE = 1200
"""Requests in a minute: twenty a second, with a minute's worth at once."""

Auth = Literal["auto", "required", "off"]


def _split(given: object) -> object:
    """Read a comma-separated list."""
    return tuple(part.strip() for part in given.split(",") if part.strip()) if isinstance(given, str) else given


Listed = Annotated[tuple[str, ...], BeforeValidator(_split), Field(description="names, commas between them")]


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceSettings:
    """How the service runs. A field NAME is read from the variable PLIANT_NAME."""

    host: str = "127.0.0.1"
    """Address to bind."""
    port: int = Field(default=8000, ge=0, le=65535)
    """TCP port to bind; 0 takes a free one."""
    max_body_mb: float = Field(default=2048.0, gt=0, le=2**20)
    """Largest body of one request, in MiB."""
    max_text_bytes: int = Field(default=1 * MB, ge=1)
    """Largest text field of a form, or whole JSON body, in bytes."""
    max_queued: int = Field(default=1000, ge=0, le=10**7)
    """Queued jobs of one token, unless the token has a limit of its own; 0: no limit. Where tokens are off, all jobs count as
    one token's."""
    requests_per_minute: int | None = Field(default=None, ge=0, le=10**7)
    """Requests per minute of one token, or of one address where tokens are off; 0: no limit; None: `USUAL_RATE` where the
    service is not on the loopback address or requires tokens, no limit elsewhere."""
    parsers: int = Field(default=2, ge=1, le=64)
    """Bodies that are parsed at once; each may hold a whole input in memory."""
    stall_seconds: float = Field(default=60.0, gt=0)
    """Seconds without a byte of an unfinished body after which the request is refused."""
    max_wait_seconds: int = Field(default=60, ge=0)
    """Longest `Prefer: wait=n` that is honoured, in seconds."""
    heartbeat_seconds: float = Field(default=15.0, gt=0)
    """Pause after which an event stream sends a comment line, in seconds."""
    allowed_hosts: Listed = ()
    """Values of the Host header that are answered, separated by commas. Empty: on the loopback address
    its usual names, on another address any."""
    auth: Auth = "auto"
    """Whether a request needs a token: `required`, `off`, or `auto`, which is off on the loopback address and required on any
    other."""
    cors_origins: Listed = ()
    """Origins whose pages may call the service, separated by commas; empty: none."""
    trusted_proxies: Listed = ()
    """Addresses or networks of proxies whose `X-Forwarded-For` names the client, separated by commas; `*` for
    any. Empty: none, because any user of the machine could choose the address that is counted."""
    presigned_redirects: bool = True
    """Whether downloads that accept it (`?redirect=true`) are redirected to S3 by a URL that is valid for five minutes. False where
    clients cannot reach the object store. Without S3 it has no effect."""
    log_level: LogLevel = "info"
    """Least level that is logged."""
    log_format: LogFormat = "console"
    """`console` for people, `json` for one JSON object a line."""

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
        """Return the requests per minute that a token with this limit of its own may send, 0 for no limit."""
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

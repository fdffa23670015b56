"""Settings of the service: one frozen record, read from the environment, a `.env` file or secret files, never on import."""

from __future__ import annotations

import ipaddress
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

MB = 2**20

USUAL_RATE = 1200
"""Requests in a minute: twenty a second, with a minute's worth at once."""

SECRETS = "/run/secrets"
"""Folder of secret files, as Docker and Kubernetes mount them, unless PLIANT_SECRETS_DIR names another one."""

Auth = Literal["auto", "required", "off"]
LogLevel = Literal["debug", "info", "warning", "error"]
LogFormat = Literal["console", "json"]


class InvalidServiceSetting(ValueError):
    """An environment variable has a value that is not allowed."""


def _split(given: object) -> object:
    """Read a comma-separated list."""
    return tuple(part.strip() for part in given.split(",") if part.strip()) if isinstance(given, str) else given


Listed = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_split)]


class ServiceSettings(BaseModel):
    """How the service runs. A field NAME is read from the variable PLIANT_NAME, except where its text says otherwise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    """Address to bind (PLIANT_HOST)."""
    port: int = Field(8000, ge=0, le=65535)
    """TCP port to bind; 0 takes a free one (PLIANT_PORT)."""
    incoming: Path = Path("pliant-data") / "incoming"
    """Folder of request bodies that are still arriving: `incoming` inside PLIANT_DATA."""
    max_body_bytes: int = Field(2048 * MB, ge=1)
    """Largest body of one request, in bytes (PLIANT_MAX_BODY_MB, in MiB)."""
    max_text_bytes: int = Field(1 * MB, ge=1)
    """Largest text field of a form, or whole JSON body, in bytes (PLIANT_MAX_TEXT_BYTES)."""
    max_queued: int = Field(1000, ge=0, le=10**7)
    """Queued jobs of one token, unless the token has a limit of its own; 0: no limit. Where tokens are off, all jobs count as
    one token's (PLIANT_MAX_QUEUED)."""
    requests_per_minute: int | None = Field(None, ge=0, le=10**7)
    """Requests per minute of one token, or of one address where tokens are off; 0: no limit; None: `USUAL_RATE` where the
    service is not on the loopback address or requires tokens, no limit elsewhere (PLIANT_REQUESTS_PER_MINUTE)."""
    parsers: int = Field(2, ge=1, le=64)
    """Bodies that are parsed at once; each may hold a whole input in memory (PLIANT_PARSERS)."""
    stall_seconds: float = Field(60.0, gt=0)
    """Seconds without a byte of an unfinished body after which the request is refused (PLIANT_STALL_SECONDS)."""
    max_wait_seconds: int = Field(60, ge=0)
    """Longest `Prefer: wait=n` that is honoured, in seconds (PLIANT_MAX_WAIT_SECONDS)."""
    heartbeat_seconds: float = Field(15.0, gt=0)
    """Pause after which an event stream sends a comment line, in seconds (PLIANT_HEARTBEAT_SECONDS)."""
    allowed_hosts: Listed = ()
    """Values of the Host header that are answered, separated by commas (PLIANT_ALLOWED_HOSTS). Empty: on the loopback address
    its usual names, on another address any."""
    auth: Auth = "auto"
    """Whether a request needs a token: `required`, `off`, or `auto`, which is off on the loopback address and required on any
    other (PLIANT_AUTH)."""
    cors_origins: Listed = ()
    """Origins whose pages may call the service, separated by commas; empty: none (PLIANT_CORS_ORIGINS)."""
    trusted_proxies: Listed = ()
    """Addresses or networks of proxies whose `X-Forwarded-For` names the client, separated by commas; `*` for any
    (PLIANT_TRUSTED_PROXIES). Empty: none, because any user of the machine could choose the address that is counted."""
    log_level: LogLevel = "info"
    """Least level that is logged (PLIANT_LOG_LEVEL)."""
    log_format: LogFormat = "console"
    """`console` for people, `json` for one JSON object a line (PLIANT_LOG_FORMAT)."""

    @classmethod
    def from_environment(cls) -> ServiceSettings:
        """Read the environment first, then `.env` in the working directory, then the folder of secret files.

        An empty variable counts as unset.

        Raises
        ------
        InvalidServiceSetting
            A value does not parse or is out of its range.
        """
        folder = os.environ.get("PLIANT_SECRETS_DIR") or SECRETS
        try:
            found = _Environment(_secrets_dir=folder if Path(folder).is_dir() else None)
        except ValidationError as error:
            first = error.errors()[0]
            name = f"PLIANT_{str(first['loc'][0]).upper()}"
            raise InvalidServiceSetting(f"{name}: {first['msg']}, got {first['input']!r}. Correct it.") from None
        given: dict[str, Any] = {name: getattr(found, name) for name in ServiceSettings.model_fields}
        given |= {"max_body_bytes": int(found.max_body_mb * MB), "incoming": found.data / "incoming"}
        return cls(**given)

    @property
    def asks_for_tokens(self) -> bool:
        """True if a request needs a token."""
        return self.auth == "required" or (self.auth == "auto" and not self.loopback)

    def rate_of(self, own: int | None) -> int:
        """Return the allowed requests per minute, 0 for no limit.

        Parameters
        ----------
        own : int or None
            The token's own limit.
        """
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


class _Environment(BaseSettings, ServiceSettings):
    """The same fields as they are spelled in the environment, where two have another unit or meaning."""

    model_config = SettingsConfigDict(
        env_prefix="PLIANT_", env_ignore_empty=True, env_file=".env", extra="ignore", frozen=True
    )

    data: Path = Path("pliant-data")
    max_body_mb: float = Field(2048.0, ge=1, le=2**20)

"""How the service runs: one frozen record, read from the environment by hand, never on import."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

MB = 2**20

USUAL_RATE = 1200
"""Requests in a minute: twenty a second, with a minute's worth at once."""

Auth = Literal["auto", "required", "off"]


class InvalidServiceSetting(ValueError):
    """An environment variable does not say what it must."""


@dataclass(frozen=True, kw_only=True)
class ServiceSettings:
    """Everything a person running the service may choose; the variable that sets it stands behind each."""

    host: str = "127.0.0.1"
    """Address to bind (PLIANT_HOST)."""
    port: int = 8000
    """TCP port to bind; 0 takes a free one (PLIANT_PORT)."""
    incoming: Path = field(default_factory=lambda: Path("pliant-data") / "incoming")
    """Where bodies are written while they arrive, on the data volume (PLIANT_DATA, its folder `incoming`)."""
    max_body_bytes: int = 2048 * MB
    """Largest body of one request, in bytes; the variable is in MiB (PLIANT_MAX_BODY_MB)."""
    max_text_bytes: int = 1 * MB
    """Largest text field of a form, or whole JSON body, in bytes."""
    max_queued: int = 1000
    """Jobs of one token that may wait at once, unless the token has a limit of its own; 0: any number. Where tokens are off,
    all jobs count as one token's (PLIANT_MAX_QUEUED)."""
    requests_per_minute: int | None = None
    """Requests per minute of one token, or of one address where tokens are off; 0: any number; not set: 1,200 where
    the service is not on the loopback address or requires tokens, any number elsewhere (PLIANT_REQUESTS_PER_MINUTE)."""
    parsers: int = 2
    """How many bodies are parsed at once; each may hold a whole input in memory (PLIANT_PARSERS)."""
    stall_seconds: float = 60.0
    """How long a client may send nothing of a body it has begun, in seconds."""
    max_wait_seconds: int = 60
    """Longest `Prefer: wait=n` that is honoured, in seconds."""
    heartbeat_seconds: float = 15.0
    """Pause after which an event stream says that it is still there, in seconds."""
    allowed_hosts: tuple[str, ...] = ()
    """Values of the Host header that are answered, commas between them (PLIANT_ALLOWED_HOSTS). Empty: on the
    loopback address its usual names, on another address any."""
    auth: Auth = "auto"
    """Whether a request needs a token: `required`, `off`, or `auto`, which is off on the loopback address and required on
    any other (PLIANT_AUTH)."""
    cors_origins: tuple[str, ...] = ()
    """Origins whose pages may call the service, commas between them; empty: none (PLIANT_CORS_ORIGINS)."""

    @classmethod
    def from_environment(cls, env: Mapping[str, str]) -> ServiceSettings:
        """Read the settings.

        Parameters
        ----------
        env : mapping of str to str
            Usually `os.environ`. Names that begin otherwise than with ``PLIANT_`` are not looked at.

        Raises
        ------
        InvalidServiceSetting
            A number is not a number, or out of its range, or a word is none of those expected.
        """
        return cls(
            host=env.get("PLIANT_HOST", cls.host),
            port=_whole(env, "PLIANT_PORT", default=cls.port, least=0, most=65535),
            incoming=Path(env.get("PLIANT_DATA", "pliant-data")) / "incoming",
            max_body_bytes=_whole(env, "PLIANT_MAX_BODY_MB", default=cls.max_body_bytes // MB, least=1, most=2**20)
            * MB,
            max_queued=_whole(env, "PLIANT_MAX_QUEUED", default=cls.max_queued, least=0, most=10**7),
            requests_per_minute=(
                _whole(env, "PLIANT_REQUESTS_PER_MINUTE", default=0, least=0, most=10**7)
                if env.get("PLIANT_REQUESTS_PER_MINUTE")
                else None
            ),
            parsers=_whole(env, "PLIANT_PARSERS", default=cls.parsers, least=1, most=64),
            auth=_auth(env),
            allowed_hosts=_listed(env, "PLIANT_ALLOWED_HOSTS"),
            cors_origins=_listed(env, "PLIANT_CORS_ORIGINS"),
        )

    @property
    def asks_for_tokens(self) -> bool:
        """True if a request needs a token."""
        return self.auth == "required" or (self.auth == "auto" and not self.loopback)

    def rate_of(self, own: int | None) -> int:
        """Return the requests in a minute that are allowed, 0 for any number.

        Parameters
        ----------
        own : int or None
            What the token says.
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


def _whole(env: Mapping[str, str], name: str, *, default: int, least: int, most: int) -> int:
    """Return an environment variable as a whole number in [least, most]."""
    text = env.get(name, "")
    if not text:
        return default
    if not text.isascii() or not text.isdigit() or not least <= int(text) <= most:
        raise InvalidServiceSetting(
            f"{name}: expected a whole number from {least} to {most}, got {text!r}. Correct it."
        )
    return int(text)


def _auth(env: Mapping[str, str]) -> Auth:
    """Return PLIANT_AUTH."""
    text = env.get("PLIANT_AUTH", "") or "auto"
    for word in get_args(Auth):
        if text == word:
            return word  # type: ignore[no-any-return]
    raise InvalidServiceSetting(f"PLIANT_AUTH: expected one of {', '.join(get_args(Auth))}, got {text!r}. Correct it.")


def _listed(env: Mapping[str, str], name: str) -> tuple[str, ...]:
    """Return a comma-separated environment variable as its parts."""
    return tuple(part.strip() for part in env.get(name, "").split(",") if part.strip())

"""Bearer tokens: create, verify, revoke.

A token has the form ``pliant_<id>_<secret>``. The id selects the record, which contains only the SHA-256 of the complete token,
so that the store reveals no usable token. A slow hash is unnecessary, because a secret of 256 random bits cannot be guessed.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any

import redis
from pliant.worker.errors import InvalidRequest, UnknownToken
from pliant.worker.records import utc_now
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect, reachable
from pydantic import BaseModel, ConfigDict

PREFIX = "pliant_"
"""Prefix of every token, for scanners of leaked secrets."""

LONGEST_TOKEN_NAME = 100

LONGEST_LIFETIME = timedelta(days=999_999)
"""Maximum lifetime of a token, so that its expiry is a valid `datetime`, whose years end at 9999."""

_FORM = re.compile(PREFIX + r"([0-9a-f]{12})_([A-Za-z0-9_-]{43})", re.ASCII)
_DURATION = re.compile(r"([1-9][0-9]{0,5})([smhdw])", re.ASCII)
_UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days", "w": "weeks"}


class Scope(StrEnum):
    """Permissions of a token. `admin` includes the others; `read` and `submit` are independent."""

    READ = "read"
    """Read the owner's jobs and download their files."""
    SUBMIT = "submit"
    """Submit jobs; cancel, retry and delete the owner's jobs."""
    ADMIN = "admin"
    """All scopes on all owners' jobs; read the metrics."""


class Token(BaseModel):
    """The stored record of a token."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    id: str
    name: str
    scopes: tuple[Scope, ...]
    owner: str
    """Owner of its jobs: its own id, or the owner of the token whose jobs it shares."""
    sha256: str
    """SHA-256 of the complete token, in hex."""
    created_at: datetime
    expires_at: datetime | None = None
    """None: never."""
    max_body_bytes: int | None = None
    """Maximum bytes of a request body; None, here and below: the service's limit."""
    max_queued: int | None = None
    """Maximum number of queued jobs."""
    max_running: int | None = None
    """Maximum number of running jobs; the others wait."""
    requests_per_minute: int | None = None
    revoked: bool = False
    """Whether it was revoked. Its record is kept without its hash, so that a deployment does not register it again."""

    def may(self, scope: Scope) -> bool:
        """Return whether the token has a scope."""
        return scope in self.scopes or Scope.ADMIN in self.scopes

    @property
    def sees_all(self) -> bool:
        """Whether the token has access to all owners' jobs."""
        return Scope.ADMIN in self.scopes

    def expired(self, now: datetime) -> bool:
        """Return whether the token has expired."""
        return self.expires_at is not None and self.expires_at <= now


class Tokens:
    """The tokens of one installation, in one hash of the store: id → record. All methods may raise `StoreUnavailable`."""

    def __init__(self, client: redis.Redis, *, prefix: str, clock: Callable[[], datetime] = utc_now) -> None:
        self._redis: Any = client
        self._key = f"{prefix}:tokens"
        self._clock = clock

    @classmethod
    def open(cls, settings: Settings) -> Tokens:
        """Return the tokens in the store of the settings; the connection is made on first use."""
        return cls(connect(settings.redis, decode=True), prefix=settings.queue)

    def create(
        self,
        name: str,
        *,
        scopes: Sequence[Scope] = (Scope.READ, Scope.SUBMIT),
        expires: timedelta | None = None,
        sharing: str | None = None,
        max_body_bytes: int | None = None,
        max_queued: int | None = None,
        max_running: int | None = None,
        requests_per_minute: int | None = None,
        text: str | None = None,
    ) -> tuple[Token, str]:
        """Create a token; return its record, and the token itself, which is not stored and cannot be shown again.

        `expires` is the lifetime; None: unlimited. `sharing` is the id of a token whose jobs the new one shares, e.g. to replace
        it. `text` is a token generated elsewhere, e.g. by a deployment; a known one is returned unchanged, a revoked one as revoked.

        Raises
        ------
        InvalidRequest
            The name is empty, too long or not printable, there is no scope, or `text` is not a token.
        UnknownToken
            `sharing` is not the id of a token.
        """
        label = " ".join(name.split())
        if not 1 <= len(label) <= LONGEST_TOKEN_NAME or not label.isprintable():
            raise InvalidRequest(
                "invalid_token_name", field="name", expected=f"1–{LONGEST_TOKEN_NAME} printable characters", got=repr(name)[:80],
                hint="Give the user or the purpose of the token.",
            )  # fmt: skip
        if not scopes:
            expected = "at least one of " + ", ".join(Scope)
            raise InvalidRequest("no_scope", field="scope", expected=expected, got="none", hint="Give --scope read.")
        owner = None if sharing is None else self.get(sharing).owner
        known = None if text is None else self._checked(text)
        if text is not None and known is not None:
            return known, text
        text = text or f"{PREFIX}{secrets.token_hex(6)}_{secrets.token_urlsafe(32)}"
        id = text.removeprefix(PREFIX)[:12]
        now = self._clock()
        token = Token(
            id=id, name=label, scopes=tuple(dict.fromkeys(scopes)), owner=owner or id, sha256=digest_of(text),
            created_at=now, expires_at=None if expires is None else now + expires, max_body_bytes=max_body_bytes,
            max_queued=max_queued, max_running=max_running, requests_per_minute=requests_per_minute,
        )  # fmt: skip
        with reachable():
            self._redis.hset(self._key, id, token.model_dump_json())
        return token, text

    def _checked(self, text: str) -> Token | None:
        """Return the record of a token generated elsewhere, None if it is new; raise InvalidRequest if it is malformed."""
        if _FORM.fullmatch(text) is None:
            raise InvalidRequest(
                "invalid_token_text", field="from", expected=f"{PREFIX}, 12 hexadecimal digits, _, 43 letters or digits",
                got=f"{len(text)} characters", hint="`pliant token create` without it generates a token.",
            )  # fmt: skip
        held = self._record(text.removeprefix(PREFIX)[:12])
        return held if held is not None and held.revoked else self.recognise(text)

    def recognise(self, text: str) -> Token | None:
        """Return the record of a token, expired or not; None if it is unknown or revoked."""
        form = _FORM.fullmatch(text)
        if form is None:
            return None
        token = self._record(form[1])
        return token if token is not None and hmac.compare_digest(token.sha256, digest_of(text)) else None

    def get(self, id: str) -> Token:
        """Return a token's record.

        Raises
        ------
        UnknownToken
            No token has this id, or it was revoked.
        """
        token = self._record(id)
        if token is None or token.revoked:
            raise UnknownToken(id)
        return token

    def _record(self, id: str) -> Token | None:
        """Return the record of a token, revoked or not; None if there is none."""
        with reachable():
            body = self._redis.hget(self._key, id)
        return None if body is None else Token.model_validate_json(body)

    def all(self) -> list[Token]:
        """Return the record of every token that is not revoked, oldest first."""
        with reachable():
            bodies = self._redis.hvals(self._key)
        tokens = [token for token in map(Token.model_validate_json, bodies) if not token.revoked]
        return sorted(tokens, key=lambda token: (token.created_at, token.id))

    def revoke(self, id: str) -> Token:
        """Revoke a token for ever, effective from the next request on. Its jobs are kept.

        Raises
        ------
        UnknownToken
            No token has this id, or it was revoked.
        """
        token = self.get(id)
        spent = token.model_copy(update={"sha256": "", "scopes": (), "revoked": True})
        with reachable():
            self._redis.hset(self._key, id, spent.model_dump_json())
        return token


def parse_duration(text: str) -> timedelta:
    """Read a duration such as ``90d``: a whole number and one of s, m, h, d, w.

    Raises
    ------
    InvalidRequest
        The duration is malformed or longer than `LONGEST_LIFETIME`.
    """
    form = _DURATION.fullmatch(text.strip())
    lasting = None if form is None else timedelta(**{_UNITS[form[2]]: int(form[1])})
    if lasting is None or lasting > LONGEST_LIFETIME:
        expected = f"a duration such as 12h, 90d or 52w, at most {LONGEST_LIFETIME.days}d"
        raise InvalidRequest(
            "invalid_duration", field="expires", expected=expected, got=repr(text)[:80],
            hint="Omit it for a token that never expires.",
        )  # fmt: skip
    return lasting


def digest_of(text: str) -> str:
    """Return what is stored of a secret."""
    return hashlib.sha256(text.encode()).hexdigest()

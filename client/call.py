"""A request as data, and its conversion to an httpx request."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from typing import Any

import httpx
from pliant.client.errors import BadArgument
from pliant.client.multipart import Form, Remainder

CONNECT_TIMEOUT = 10.0
"""Seconds allowed for opening a connection."""

REDIRECT_TIMEOUT = 5.0
"""The same for the object store that the service redirects to; shorter, because the service itself is the fallback."""

SILENCE_TIMEOUT = 60.0
"""Seconds without a byte after which a connection counts as lost, in addition to the delay that the call asks for."""


@dataclass(frozen=True, kw_only=True)
class Call:
    """One request, which can be sent any number of times."""

    method: str
    path: str
    """Relative to the service's address, e.g. ``/v1/jobs``."""
    params: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    form: Form | None = None
    """Multipart body; its files are reopened for each attempt."""
    body: Remainder | None = None
    """Raw body from a file, which is also reopened for each attempt."""
    content: bytes | None = None
    """Short body, sent as it is."""
    delay: float = 0.0
    """Seconds for which the service may delay its response."""
    changes_nothing: bool = False
    """True for a POST that has no side effects or has them only once."""

    @property
    def repeatable(self) -> bool:
        """True if sending it twice has the same effect as sending it once."""
        safe = self.changes_nothing or self.method in ("GET", "HEAD", "PUT", "DELETE")
        return safe or "Idempotency-Key" in self.headers


def base_of(url: str) -> str:
    """Check the address of a service and return it without a trailing slash.

    Raises
    ------
    BadArgument
        The text is not an http or https address, or it has a query.
    """
    try:
        parsed = httpx.URL(url)
        valid = parsed.scheme in ("http", "https") and parsed.host != "" and not parsed.query
    except (httpx.InvalidURL, TypeError):
        valid = False
    if not valid:
        raise BadArgument(f"Expected the address of a service such as http://127.0.0.1:8000, got {url!r}.")
    return str(url).rstrip("/")


@cache
def user_agent() -> str:
    """Return the client's name and version, which is read from files once."""
    return f"pliant-client/{version('pliant')}"


def headers_of(token: str | None, more: Mapping[str, str] | None) -> dict[str, str]:
    """Return the headers of every request; the caller's own take precedence.

    Raises
    ------
    BadArgument
        The token is not a text, or has characters that no token has; or a header is no text that HTTP allows. The message does not
        show them.
    """
    headers = {"User-Agent": user_agent()}
    if token is not None and not isinstance(token, str):
        raise BadArgument(f"token: expected a str, got a value of type {type(token).__name__}.")
    token = "" if token is None else token.strip()
    if token:
        if not token.isascii() or not token.isprintable() or " " in token:
            raise BadArgument(
                "token, or PLIANT_TOKEN: expected ASCII letters, digits and signs, got others. Copy the token again."
            )
        headers["Authorization"] = f"Bearer {token}"
    if more is None:
        return headers
    if not isinstance(more, Mapping):
        raise BadArgument(f"headers: expected a mapping of str to str, got a value of type {type(more).__name__}.")
    for name, value in more.items():
        if not isinstance(name, str) or re.fullmatch(r"[\w!#$%&'*+.^`|~-]+", name, re.ASCII) is None:
            raise BadArgument(f"headers: expected names of ASCII letters, digits and dashes, got {name!r}.")
        if not isinstance(value, str) or re.fullmatch(r"(?! )[ -~]*(?<! )", value) is None:
            raise BadArgument(
                f"headers: expected a str of printable ASCII characters, without spaces around it, for {name}, got another value. "
                "Encode other text, for example with urllib.parse.quote."
            )
    return {**headers, **more}


def request_for(
    http: httpx.Client | httpx.AsyncClient, call: Call, timeout: float, sending: ExitStack
) -> httpx.Request:
    """Build the request; the files that it reads stay open until `sending` is closed."""
    if call.body is not None:
        return _raw(http, call, call.body, timeout)
    files: dict[str, Any] | None = None
    if call.form is not None:  # a form without files is sent as multipart, too
        texts = {name: (None, text) for name, text in call.form.fields.items()}
        files = {**texts, **sending.enter_context(call.form.open())}
    return http.build_request(
        call.method,
        call.path,
        params=dict(call.params) or None,
        headers=httpx.Headers(dict(call.headers), encoding="utf-8"),  # an Idempotency-Key may be any text
        files=files,
        content=call.content,
        timeout=_limits(timeout, delay=call.delay),
    )


def redirected(location: str, call: Call, timeout: float) -> httpx.Request:
    """Build the request that follows a redirect to an object store.

    The client's token and other headers must not be sent to the store. `If-Range` is omitted, too: the store's entity tags differ
    from the service's, which has already evaluated it.
    """
    names = ("Accept-Encoding", "Range")
    headers = {"User-Agent": user_agent()}
    headers |= {name: call.headers[name] for name in names if name in call.headers}
    limits = _limits(timeout).as_dict() | {"connect": min(REDIRECT_TIMEOUT, timeout)}
    return httpx.Request("GET", location, headers=headers, extensions={"timeout": limits})


def _raw(http: httpx.Client | httpx.AsyncClient, call: Call, rest: Remainder, timeout: float) -> httpx.Request:
    """Build a request whose body is the remainder of a file, for either kind of client."""
    length = rest.path.stat().st_size - rest.offset
    headers = {**call.headers, "Content-Length": str(length), "Content-Type": "application/octet-stream"}
    plain = http.build_request(call.method, call.path, headers=headers, timeout=_limits(timeout))
    return httpx.Request(
        plain.method, plain.url, headers=plain.headers, stream=_Stream(rest), extensions=plain.extensions
    )


class _Stream(httpx.SyncByteStream, httpx.AsyncByteStream):
    def __init__(self, rest: Remainder) -> None:
        self._rest = rest

    def __iter__(self) -> Iterator[bytes]:
        yield from self._rest.pieces()

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for piece in self._rest.pieces():
            yield piece


def _limits(timeout: float, *, delay: float = 0.0) -> httpx.Timeout:
    return httpx.Timeout(
        min(SILENCE_TIMEOUT, timeout), read=min(SILENCE_TIMEOUT + delay, timeout), connect=min(CONNECT_TIMEOUT, timeout)
    )

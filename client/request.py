"""From a call to an httpx request; the same for both clients."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack
from importlib.metadata import version
from typing import Any

import httpx
from pliant.client.errors import BadArgument
from pliant.client.flow import Call
from pliant.client.multipart import Rest

CONNECT_TIMEOUT = 10.0
"""Seconds for a connection to come about."""

SILENCE_TIMEOUT = 60.0
"""Seconds without a byte after which a connection counts as lost; longer than any answer is held back."""


def base_of(url: str) -> str:
    """Check the address of a service.

    Raises
    ------
    BadArgument
        Not an http or https address.
    """
    parsed = httpx.URL(url)
    if parsed.scheme not in ("http", "https") or parsed.host == "":
        raise BadArgument(f"Expected the address of a service such as http://127.0.0.1:8000, got {url!r}.")
    return url.rstrip("/")


def headers_of(token: str | None) -> dict[str, str]:
    """Headers of every request."""
    headers = {"User-Agent": f"pliant-client/{version('pliant')}"}
    return headers if token is None else {**headers, "Authorization": f"Bearer {token}"}


def request_for(
    http: httpx.Client | httpx.AsyncClient, call: Call, timeout: float, sending: ExitStack
) -> httpx.Request:
    """Build the request; files it reads from are open until `sending` is closed."""
    if call.body is not None:
        return _raw(http, call, call.body, timeout)
    files: dict[str, Any] | None = None
    if call.form is not None:  # a form of texts alone is a multipart form, too
        texts = {name: (None, text) for name, text in call.form.fields.items()}
        files = {**texts, **sending.enter_context(call.form.open())}
    return http.build_request(
        call.method,
        call.path,
        params=dict(call.params) or None,
        headers=dict(call.headers),
        files=files,
        timeout=_limits(timeout),
    )


def _raw(http: httpx.Client | httpx.AsyncClient, call: Call, rest: Rest, timeout: float) -> httpx.Request:
    """Build a request whose body is the rest of a file; httpx takes only streams of one kind, and this one serves both."""
    length = rest.path.stat().st_size - rest.offset
    headers = {**call.headers, "Content-Length": str(length), "Content-Type": "application/octet-stream"}
    plain = http.build_request(call.method, call.path, headers=headers, timeout=_limits(timeout))
    return httpx.Request(
        plain.method, plain.url, headers=plain.headers, stream=_Stream(rest), extensions=plain.extensions
    )


class _Stream(httpx.SyncByteStream, httpx.AsyncByteStream):
    def __init__(self, rest: Rest) -> None:
        self._rest = rest

    def __iter__(self) -> Iterator[bytes]:
        yield from self._rest.pieces()

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for piece in self._rest.pieces():
            yield piece


def _limits(timeout: float) -> httpx.Timeout:
    finite = timeout if math.isfinite(timeout) else SILENCE_TIMEOUT
    return httpx.Timeout(min(SILENCE_TIMEOUT, finite), connect=min(CONNECT_TIMEOUT, finite))

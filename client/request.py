"""From a call to an httpx request; the same for both clients."""

from __future__ import annotations

import math
from contextlib import ExitStack
from importlib.metadata import version

import httpx
from pliant.client.errors import BadArgument
from pliant.client.flow import Call

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
    finite = timeout if math.isfinite(timeout) else SILENCE_TIMEOUT
    limits = httpx.Timeout(min(SILENCE_TIMEOUT, finite), connect=min(CONNECT_TIMEOUT, finite))
    files = None if call.form is None else sending.enter_context(call.form.open())
    return http.build_request(
        call.method,
        call.path,
        params=dict(call.params) or None,
        headers=dict(call.headers),
        data=None if call.form is None else dict(call.form.fields),
        files=files,
        timeout=limits,
    )

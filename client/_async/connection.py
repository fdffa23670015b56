"""The connection of a client to its service: address, token, TLS, retries."""

from __future__ import annotations

import os
import ssl
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

import httpx
from pliant.client._async.transport import Exchange
from pliant.client.call import base_of, headers_of
from pliant.client.errors import BadArgument
from pliant.client.retry import Attempts, Contact, Retry

DEFAULT_URL = "http://127.0.0.1:8000"

UNLIMITED = httpx.Limits(max_connections=None, max_keepalive_connections=20)
"""As many connections as the program has calls under way: a wait or an event stream holds one, and beyond httpx's 100 others would
starve. Idle connections are kept as by default."""


class AsyncConnection:
    """Base class of `AsyncClient`, which documents the parameters. Close it, or use it in a ``with`` block."""

    url: str
    """Address of the service, without user name and password, and without a slash at the end."""

    def __init__(
        self,
        url: str | None = None,
        *,
        token: str | None = None,
        headers: Mapping[str, str] | None = None,
        verify: bool | ssl.SSLContext = True,
        retries: Retry = Retry(),  # noqa: B008 - frozen, so all clients may share it
        event_hooks: Mapping[str, list[Callable[..., Any]]] | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        if not isinstance(retries, Retry):
            raise BadArgument(f"retries: expected a Retry, such as Retry(patience=10), got {retries!r}.")
        address = base_of(url if url is not None else os.environ.get("PLIANT_URL") or DEFAULT_URL)
        self.url = str(httpx.URL(address).copy_with(userinfo=b""))
        bearer = token if token is not None else os.environ.get("PLIANT_TOKEN") or None
        every = headers_of(bearer, headers)
        try:
            self._http = httpx.AsyncClient(
                base_url=address,
                headers=every,
                verify=verify,
                limits=UNLIMITED,
                event_hooks=event_hooks,
                transport=transport,
            )
        # A SOCKS proxy, a file of certificates, the address of a proxy.
        except (ImportError, OSError, ValueError) as fault:
            raise BadArgument(
                f"The connections cannot be set up: {str(fault).rstrip('.')}. Check verify and the environment variables HTTP_PROXY, "
                "HTTPS_PROXY, ALL_PROXY, NO_PROXY, SSL_CERT_FILE and SSL_CERT_DIR."
            ) from fault
        self._retries = retries
        self._contact = Contact(url=self.url)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.url}>"

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, _: object) -> Self:
        return self

    def __getstate__(self) -> object:
        raise TypeError(
            f"A {type(self).__name__} has connections and a token and cannot be pickled. Create one in each process, and pass ids of jobs."
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    def _exchange(self, timeout: float | None, doing: str = "the call") -> Exchange:
        if self._http.is_closed:
            raise BadArgument("The client is closed. Create a new one.")
        attempts = Attempts(retries=self._retries, contact=self._contact, timeout=timeout, doing=doing)
        return Exchange(self._http, attempts)

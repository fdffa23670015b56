"""One log line for every request, with the request's id, its job, and the code of a refusal.

Neither query strings nor header values other than the request id are logged, so no token or secret reaches the log.
"""

from __future__ import annotations

import logging
import re
import secrets
import time
from collections.abc import Callable

from pliant.service.middleware.origin import FOR_MACHINES
from pliant.worker.logs import REQUEST_ID
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADER = "X-Request-ID"

READINESS = "/readyz"
"""The path whose answer 503 is an expected one: the service is starting, or waits for its store. It is logged at level info;
what is unavailable is logged by the part that uses it."""

_ALLOWED = re.compile(r"[A-Za-z0-9._:+=/-]{1,128}")
_JOB = re.compile(r"/v1/jobs/([A-Za-z0-9_-]{3,64})")

_log = logging.getLogger("pliant.access")


class AccessLog:
    """ASGI middleware, the outermost: gives each request an id, returns it as `X-Request-ID`, and logs the outcome.

    The `X-Request-ID` of a client or proxy is kept if it consists of at most 128 letters, digits or ``._:+=/-``.
    """

    def __init__(self, app: ASGIApp, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._app = app
        self._clock = clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and log it when it has ended."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get(HEADER, "")
        id = given if _ALLOWED.fullmatch(given) else secrets.token_hex(8)
        kept: dict[str, str] = {"request_id": id}
        scope["pliant.log"] = kept
        REQUEST_ID.set(id)
        begun, status = self._clock(), 0

        async def watched(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[HEADER] = id
                if (found := _JOB.fullmatch(headers.get("location", ""))) is not None:
                    kept["job"] = found[1]
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except Exception:
            if status == 0:
                status = 500
                kept["code"] = "internal_error"
            raise
        finally:
            _write(scope, kept, status=status, seconds=self._clock() - begun)


def _write(scope: Scope, kept: dict[str, str], *, status: int, seconds: float) -> None:
    """Log one request: errors of the service at level error, refusals at warning, others and those of readiness at info.

    Status 0: the client disconnected first.
    """
    # The path as it was sent, percent-encoded, so that it cannot hold a line break.
    path = bytes(scope.get("raw_path") or scope["path"].encode()).decode("ascii", "backslashreplace")[:200]
    level = logging.ERROR if status >= 500 else logging.WARNING if status >= 400 else logging.INFO
    if scope["path"] == READINESS and status == 503:
        level = logging.INFO
    elif level == logging.INFO and scope["path"] in FOR_MACHINES:
        level = logging.DEBUG
    found = _JOB.match(scope["path"])
    token = scope.get("pliant.token")
    fields: dict[str, object] = {
        "method": scope["method"],
        "path": path,
        "status": status,
        "ms": round(seconds * 1000, 1),
        "job": kept.get("job") or (found[1] if found else None),
        "code": kept.get("code"),
        "token": None if token is None else token.id,
    }
    given = {name: value for name, value in fields.items() if value is not None}
    more = "".join(f" {name}={given[name]}" for name in ("job", "code", "token") if name in given)
    _log.log(level, "%s %s %d %.1f ms%s", scope["method"], path, status, seconds * 1000, more, extra=given)

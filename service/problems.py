"""Every error as RFC 9457 problem details, made in one place.

An exception becomes a `Problem` by one table, from its class to a status code; what it says (code, field, expected, got, hint)
travels in its attributes. FastAPI's own answers (404, 405, 422) take the same road, so a client needs one parser.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pliant.schemas.job import Problem
from pydantic import ValidationError
from starlette.exceptions import HTTPException

MEDIA_TYPE = "application/problem+json"
RETRYABLE = frozenset({429, 503, 507})
"""Answers that may be different later though the request is the same."""

_log = logging.getLogger("pliant.service")

_SAID_BY_STATUS = {
    400: ("bad_request", "The request could not be read. Compare it with the example at /docs."),
    401: ("unauthorised", "Send a token as `Authorization: Bearer …`."),
    404: ("no_such_address", "There is nothing at this address. The addresses are listed at /docs."),
    405: ("method_not_allowed", "This address does not know this method. The methods are listed at /docs."),
    413: ("body_too_large", "Send a smaller body; the limits are at /v1/limits."),
    415: ("unsupported_media_type", "Send multipart/form-data or application/json; see /docs."),
    500: ("internal_error", "The service failed; its log says more. Try again, and report it if it stays."),
}


class Refusal(Exception):
    """The service will not do what the request asks; said as a problem.

    Attributes
    ----------
    status : int
        The HTTP status code.
    code : str
        Stable machine-readable name of the fault.
    detail : str
        A whole sentence that ends with what to do next.
    said : dict
        Further members of `Problem`: ``field``, ``expected``, ``got``, ``hint``, ``choices``.
    headers : dict of str to str
        Further response headers.
    """

    def __init__(
        self, status: int, code: str, *, detail: str, headers: Mapping[str, str] | None = None, **said: Any
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.said = said
        self.headers = dict(headers or {})


def problem(status: int, code: str, *, detail: str, **said: Any) -> Problem:
    """Return a `Problem` whose title is the status code's name.

    Parameters
    ----------
    status : int
        HTTP status code.
    code : str
        Stable machine-readable name.
    detail : str
        A whole sentence that ends with what to do.
    **said
        Further members of `Problem`.
    """
    said.setdefault("retryable", status in RETRYABLE)
    return Problem(title=HTTPStatus(status).phrase, status=status, code=code, detail=detail, **said)


def answer(what: Problem, *, headers: Mapping[str, str] | None = None) -> Response:
    """Return the response that carries a problem; members that say nothing are left out."""
    return Response(
        what.model_dump_json(exclude_none=True),
        status_code=what.status,
        headers=dict(headers or {}),
        media_type=MEDIA_TYPE,
    )


def from_error(error: Exception, status: int) -> Problem:
    """Return the problem of one of our errors: its own code, field, expected, got, hint and choices where it has them.

    Parameters
    ----------
    error : Exception
        An error with at least a ``code`` attribute.
    status : int
        What the table gives for its class.
    """
    said = {name: getattr(error, name, None) for name in ("field", "expected", "got", "hint", "choices")}
    return problem(status, str(getattr(error, "code", "internal_error")), detail=str(error), **said)


def from_validation(errors: Sequence[Any], *, prefix: str) -> Problem:
    """Return the problem of values that pydantic refused: the first fault in full, the others counted.

    Parameters
    ----------
    errors : sequence of dict
        `ValidationError.errors()`.
    prefix : str
        Where the values stood, e.g. ``"options"``; put before the field's name.
    """
    first = errors[0]
    where = [str(part) for part in first["loc"] if part not in ("body", "query", "path", "header")]
    field = ".".join([prefix, *where] if prefix else where) or prefix or "request"
    unknown = first["type"] == "extra_forbidden"
    expected = "a name listed at /v1/options" if unknown else first["msg"]
    got = f"the unknown name {where[-1]!r}" if unknown else _short(first.get("input"))
    others = f" {len(errors) - 1} further fault(s) follow." if len(errors) > 1 else ""
    return problem(
        422,
        f"unknown_{prefix.removesuffix('s')}" if unknown else f"invalid_{prefix.removesuffix('s') or 'request'}",
        detail=f"{field}: expected {expected}, got {got}.{others} The schema is at /v1/options.",
        field=field,
        expected=expected,
        got=got,
        hint="Compare with the schema at /v1/options.",
    )


def _short(value: object) -> str:
    """Return a value as a person may see it, never more than 80 characters of a stranger's text."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "…"


def install(app: FastAPI, table: Mapping[type[Exception], int], *, careful: Mapping[str, str]) -> None:
    """Make every error of the app a problem.

    Parameters
    ----------
    app : FastAPI
        The application.
    table : mapping of exception class to int
        Status code by class; a subclass not named takes its nearest base's.
    careful : mapping of str to str
        Headers of the answer to a defect, which is made outside all middleware.
    """

    async def refused(_: Request, error: Exception) -> Response:
        assert isinstance(error, Refusal)
        return answer(problem(error.status, error.code, detail=error.detail, **error.said), headers=error.headers)

    async def of_ours(_: Request, error: Exception) -> Response:
        status = next(table[base] for base in type(error).__mro__ if base in table)
        after = getattr(error, "retry_after", None)
        return answer(from_error(error, status), headers=None if after is None else {"Retry-After": str(after)})

    async def of_http(_: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        code, detail = _SAID_BY_STATUS.get(error.status_code, ("http_error", f"{error.detail}. See /docs."))
        return answer(problem(error.status_code, code, detail=detail), headers=error.headers)

    async def of_validation(_: Request, error: Exception) -> Response:
        assert isinstance(error, (RequestValidationError, ValidationError))
        return answer(from_validation(error.errors(), prefix=""))

    async def of_disk(request: Request, error: Exception) -> Response:
        assert isinstance(error, OSError)
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            return await unforeseen(request, error)
        _log.error("the data volume is full: %s", error)
        detail = (
            "The service has no room on its disk; nothing was kept. Try later, or ask whoever runs it to free space."
        )
        return answer(problem(507, "storage_full", detail=detail))

    async def unforeseen(request: Request, error: Exception) -> Response:
        # Starlette raises it again after this answer, so the server's log has the traceback; the client never sees it.
        _log.error("unforeseen %s at %s %s", type(error).__name__, request.method, request.url.path)
        code, detail = _SAID_BY_STATUS[500]
        return answer(problem(500, code, detail=detail), headers={**careful, "Cache-Control": "no-store"})

    app.add_exception_handler(Refusal, refused)
    app.add_exception_handler(HTTPException, of_http)
    app.add_exception_handler(RequestValidationError, of_validation)
    app.add_exception_handler(OSError, of_disk)
    app.add_exception_handler(Exception, unforeseen)
    for kind in table:
        app.add_exception_handler(kind, of_ours)

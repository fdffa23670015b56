"""The conversion of every error to RFC 9457 problem details.

The error's code determines the status; code, field, expected, got and hint are attributes of the exception.
FastAPI's own errors (404, 405, 422) are converted the same way, so a client needs one parser.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pliant.schemas.invalid import Invalid, members_of
from pliant.schemas.job import Problem
from pliant.schemas.option_faults import option_fault, shown
from pliant.schemas.problems import ProblemCode, find_code
from pliant.schemas.validation import expectation
from pliant.worker.errors import QuotaExceeded, WorkerError
from pliant.worker.formats import InvalidInput
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import BaseRoute, Match, Route
from starlette.types import Receive, Scope, Send

MEDIA_TYPE = "application/problem+json"

_log = logging.getLogger("pliant.service")

_BY_STATUS = {
    404: (ProblemCode.NO_SUCH_ADDRESS, "No route has this path. All paths are listed at /docs."),
    405: (ProblemCode.METHOD_NOT_ALLOWED, "This path does not support this method. The methods are listed at /docs."),
    500: (ProblemCode.INTERNAL_ERROR, "The service failed; its log has the details. Report it if it happens again."),
}


class Refusal(Exception):
    """The service refuses a request; the answer is a problem document.

    Attributes
    ----------
    code : ProblemCode
        Stable machine-readable name of the error.
    detail : str
        A complete sentence that ends with what to do next.
    status : int
        The HTTP status code; by default the code's usual one.
    members : dict
        Further members of `Problem`: ``field``, ``expected``, ``got``, ``hint``, ``choices``, ``type``.
    headers : dict of str to str
        Further response headers.
    """

    def __init__(
        self,
        code: ProblemCode,
        *,
        detail: str,
        status: int | None = None,
        headers: Mapping[str, str] | None = None,
        **members: Any,
    ) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail
        self.status = status or code.status or 500
        self.members = members
        self.headers = dict(headers or {})


class ProblemResponse(Response):
    """A response with a problem document; it stores the code in the request's scope for the access log."""

    media_type = MEDIA_TYPE

    def __init__(self, problem: Problem, *, headers: Mapping[str, str] | None = None) -> None:
        body = problem.model_dump_json(exclude_none=True)
        super().__init__(body, status_code=problem.status, headers=dict(headers or {}))
        self._code = problem.code

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the response."""
        if "pliant.log" in scope:
            scope["pliant.log"]["code"] = self._code
        await super().__call__(scope, receive, send)


def wrong_input(code: ProblemCode, *, field: str, expected: str, got: str, hint: str, **more: Any) -> Refusal:
    """Return (not raise) the refusal of an input; `more` is passed to `Refusal`."""
    return refused(Invalid(code, field=field, expected=expected, got=got, hint=hint), **more)


def refused(error: Invalid, **more: Any) -> Refusal:
    """Return the refusal for an error about an invalid value; `more` is passed to `Refusal`."""
    return Refusal(ProblemCode(error.code), detail=str(error), **{**members_of(error), **more})


def answer(
    code: ProblemCode,
    *,
    detail: str,
    headers: Mapping[str, str] | None = None,
    status: int | None = None,
    **members: Any,
) -> ProblemResponse:
    """Return the response for a code, which determines type, title and, unless `status` is given, the status.

    `detail` is a complete sentence that ends with what to do; `members` are further members of `Problem`.
    """
    return ProblemResponse(Problem.of(code, status, detail=detail, **members), headers=headers)


def of_error(error: WorkerError | InvalidInput) -> ProblemResponse:
    """Return the response for a worker's or reader's error, with its code, field, expected, got, hint and choices."""
    code = find_code(error.code)
    status = None if code is None else code.status
    if status is None:
        status = 422 if isinstance(error, Invalid) else 500
    after = getattr(error, "retry_after", None)
    again = {"retryable": error.retryable} if isinstance(error, QuotaExceeded) else {}
    problem = Problem.of(error.code, status, detail=str(error), **again, **members_of(error))
    return ProblemResponse(problem, headers=None if after is None else {"Retry-After": str(after)})


def from_validation(errors: Sequence[Any], *, options: bool = False) -> Refusal:
    """Return the refusal of values that pydantic rejected: the first error in full, and the number of others.

    The values are a job's options if `options` is True, else parameters of the request.
    """
    first = errors[0]
    others = f" {len(errors) - 1} further error(s) follow." if len(errors) > 1 else ""
    if options:
        fault = option_fault(first)
        hint = f"{fault.hint} Compare with the schema at /v1/options.{others}".strip()
        code = ProblemCode(fault.code)
        return wrong_input(code, field=fault.field, expected=fault.expected, got=fault.got, hint=hint)
    place, *inside = first["loc"] or ("request",)
    if place in ("query", "path", "header"):  # what follows the name is a position that the client did not write
        where = [str(part) for part in inside[:1]]
    else:
        where = [str(part) for part in first["loc"] if part != "body"]
    got = "nothing" if first["type"] == "missing" else shown(first.get("input"))
    return wrong_input(
        ProblemCode.INVALID_REQUEST, field=".".join(where) or "request", expected=expectation(first), got=got,
        hint=f"Compare with the schema at /docs.{others}",
    )  # fmt: skip


def install(app: FastAPI, *, routes: Sequence[BaseRoute], security_headers: Mapping[str, str]) -> None:
    """Answer every error of the app with a problem document.

    `routes` are those whose methods the header `Allow` lists. `security_headers` are for the response to an unexpected exception, which
    is created outside all middleware.
    """
    app.add_exception_handler(Refusal, _of_refusal)
    paths = [route for route in routes if isinstance(route, Route)]
    app.add_exception_handler(HTTPException, partial(_of_http, routes=paths))
    app.add_exception_handler(RequestValidationError, _of_validation)
    app.add_exception_handler(ClientDisconnect, _of_disconnect)
    app.add_exception_handler(OSError, partial(_of_disk, security_headers=security_headers))
    app.add_exception_handler(Exception, partial(_unforeseen, security_headers=security_headers))
    for kind in (WorkerError, InvalidInput):
        app.add_exception_handler(kind, _of_ours)


async def _of_refusal(_: Request, error: Exception) -> Response:
    assert isinstance(error, Refusal)
    return answer(error.code, detail=error.detail, headers=error.headers, status=error.status, **error.members)


async def _of_http(request: Request, error: Exception, *, routes: Sequence[Route]) -> Response:
    assert isinstance(error, HTTPException)
    headers = dict(error.headers or {})
    if error.status_code == 405:  # the router names the methods of only the first route with this path
        matching = [route for route in routes if route.matches(request.scope)[0] is not Match.NONE]
        if methods := {method for route in matching for method in route.methods or ()}:
            headers["Allow"] = ", ".join(sorted(methods))
    usual = (ProblemCode.HTTP_ERROR, f"{error.detail}. See /docs.")
    code, detail = _BY_STATUS.get(error.status_code, usual)
    return answer(code, detail=detail, status=error.status_code, headers=headers)


async def _of_validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    return await _of_refusal(request, from_validation(error.errors()))


async def _of_disconnect(_: Request, __: Exception) -> Response:
    # Only for the access log: the client has disconnected.
    return answer(
        ProblemCode.BAD_REQUEST, detail="The connection closed before the body was complete. Nothing was kept."
    )


async def _of_ours(_: Request, error: Exception) -> Response:
    assert isinstance(error, (WorkerError, InvalidInput))
    found = of_error(error)
    if found.status_code >= 500:
        _log.error("%s: %s", type(error).__name__, error, exc_info=error if found.status_code == 500 else None)
    return found


async def _of_disk(request: Request, error: Exception, security_headers: Mapping[str, str]) -> Response:
    assert isinstance(error, OSError)
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return await _unforeseen(request, error, security_headers)
    _log.error("the data volume is full: %s", error)
    detail = "The service's disk is full; nothing was kept. Try later, or ask the operator to free space."
    return answer(ProblemCode.STORAGE_FULL, detail=detail)


async def _unforeseen(request: Request, error: Exception, security_headers: Mapping[str, str]) -> Response:
    # Starlette raises the error again after this response, so the server's log has the traceback; the client never sees it.
    _log.error("unexpected %s in %s %s", type(error).__name__, request.method, request.url.path)
    code, detail = _BY_STATUS[500]
    kept: dict[str, str] = request.scope.get("pliant.log", {})
    own = {"X-Request-ID": kept["request_id"]} if "request_id" in kept else {}
    return answer(code, detail=detail, headers={**security_headers, **own, "Cache-Control": "no-store"})

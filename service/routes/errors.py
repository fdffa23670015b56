"""Explanations of error codes, at the address in `Problem.type`."""

from __future__ import annotations

import re
from html import escape
from typing import Annotated

from fastapi import Header, Path
from fastapi.responses import HTMLResponse, Response
from pliant.schemas.job import Record
from pliant.schemas.problems import ProblemCode
from pliant.service.openapi import problems
from pliant.service.problems import Refusal
from pliant.service.routes.router import Router
from pydantic import Field

router = Router(prefix="/errors", tags=["about"])


class ErrorCode(Record):
    """Explanation of an error code."""

    code: ProblemCode = Field(description="Stable machine-readable name of the error.")
    status: int | None = Field(description="Usual HTTP status; null if no HTTP answer carries the code.")
    title: str = Field(description="Short name of the error.")
    cause: str = Field(description="When the error occurs.")
    remedy: str = Field(description="What to do.")
    retryable: bool = Field(description="True if the same request can succeed later.")


@router.get("", operation_id="list_error_codes", summary="List error codes")
def error_codes() -> list[ErrorCode]:
    """Return every error code with its cause and remedy."""
    return [explain(code) for code in ProblemCode]


@router.get(
    "/{code}",
    operation_id="get_error_code",
    summary="Explain an error code",
    response_model=ErrorCode,
    responses={200: {"content": {"text/html": {"schema": {"type": "string"}}}}, **problems(404)},
)
def error_code(
    code: Annotated[str, Path(description="The `code` of a problem.", examples=["unknown_job"])],
    accept: Annotated[str, Header(description="`text/html` for a page, else JSON.")] = "",
) -> Response:
    """Return cause and remedy of an error code, as JSON or as a page for browsers."""
    if code not in list(ProblemCode):
        detail = "No error has this code. All codes are listed at /errors."
        raise Refusal(ProblemCode.NO_SUCH_ADDRESS, detail=detail, got=code[:80])
    found = explain(ProblemCode(code))
    headers = {"Cache-Control": "public, max-age=3600", "Vary": "Accept"}
    if "text/html" in accept:
        return HTMLResponse(page_of(found), headers=headers)
    return Response(found.model_dump_json(), media_type="application/json", headers=headers)


def explain(code: ProblemCode) -> ErrorCode:
    """Return the explanation of a code."""
    return ErrorCode(
        code=code,
        status=code.status,
        title=code.heading,
        cause=code.cause,
        remedy=code.remedy,
        retryable=code.retryable,
    )


def page_of(error: ErrorCode) -> str:
    """Return the HTML page of a code, without styles and scripts, as the content security policy of the API requires."""
    status = "" if error.status is None else f"<p>HTTP status {error.status}</p>"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{escape(error.code)}: {escape(error.title)}</title>"
        f"<h1>{escape(error.title)}</h1><p><code>{escape(error.code)}</code></p>{status}"
        f"<h2>Cause</h2><p>{_with_code(error.cause)}</p><h2>Remedy</h2><p>{_with_code(error.remedy)}</p>"
        '<p><a href="../guide">Guide: what can be sent, and what comes back</a></p></html>\n'
    )


def _with_code(text: str) -> str:
    """Return a sentence as HTML; what stands between backticks is code."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text))

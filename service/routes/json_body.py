"""JSON bodies of requests: limited in size and time, parsed into a model."""

from __future__ import annotations

from typing import Any, TypeVar

from fastapi import Request
from pliant.schemas.problems import ProblemCode
from pliant.service.dependencies import service_of
from pliant.service.multipart import batches
from pliant.service.problems import Refusal, from_validation
from pydantic import BaseModel, ValidationError

Model = TypeVar("Model", bound=BaseModel)


async def read_json(request: Request, model: type[Model]) -> Model:
    """Return the parsed body of a request; an empty body counts as an empty JSON object.

    Raises
    ------
    Refusal
        413: too large; 408: stalled; 415: another media type; 422: not JSON, or invalid for the model.
    """
    settings = service_of(request).settings
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind not in ("", "application/json"):
        detail = "The body must be JSON: send it with `Content-Type: application/json`. An example is at /docs."
        code = ProblemCode.UNSUPPORTED_MEDIA_TYPE
        raise Refusal(code, detail=detail, field="Content-Type", expected="application/json", got=kind[:80])
    pieces = batches(request, max_bytes=settings.max_text_bytes, stall_seconds=settings.stall_seconds)
    body = b"".join([piece async for piece in pieces])
    try:
        return model.model_validate_json(body or b"{}")
    except ValidationError as error:
        raise from_validation(error.errors()) from None


def body_of(model: type[BaseModel], *, required: bool) -> dict[str, Any]:
    """Return the OpenAPI description of a body that `read_json` reads."""
    return {
        "requestBody": {
            "required": required,
            "content": {"application/json": {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}}},
        }
    }

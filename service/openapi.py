"""What the OpenAPI document says beyond what FastAPI reads from the code: errors, examples, the form."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from pliant.schemas.job import Problem
from pliant.service.middleware.auth import is_public
from pliant.service.problems import MEDIA_TYPE

SUMMARY = "Dense 2-D point tracks of a deforming thing in, a moving 3-D mesh out."
DESCRIPTION = """Submit a job with `POST /v1/jobs`, follow it, download its files.

Every error is `application/problem+json` with a stable `code`, a `detail` that is a whole sentence and ends with what to do,
and, where an input is at fault, `field`, `expected`, `got` and `hint`. `retryable` says whether the same request may succeed later.
"""

_PROBLEM_EXAMPLE = {
    "type": "about:blank",
    "title": "Unprocessable Content",
    "status": 422,
    "detail": "tracks: expected at least 3 frames, got 2. Track the points over more frames.",
    "code": "too_few_frames",
    "field": "tracks",
    "expected": "at least 3 frames",
    "got": "2",
    "hint": "Track the points over more frames.",
    "retryable": False,
}

JOB_EXAMPLE: dict[str, Any] = {
    "application/json": {
        "example": {
            "id": "4f0c6b1d2a9e8c7b5d3f",
            "name": "face, take 3",
            "status": "running",
            "created_at": "2026-05-04T09:30:00Z",
            "started_at": "2026-05-04T09:30:01Z",
            "attempt": 1,
            "options": {"method": "robust", "camera": "scaled_orthographic"},
            "interpretation": {
                "num_frames": 99,
                "num_points": 2880,
                "num_faces": 5600,
                "hidden_fraction": 0.02,
                "mesh_source": "given",
                "has_ground_truth": False,
                "has_rotations": False,
                "layout": "tracks (F, P, 2)",
                "y_axis": "down",
                "notes": [],
            },
            "progress": {
                "stage": "reweight",
                "fraction": 0.4,
                "reweighting": 9,
                "max_reweightings": 30,
                "objective": 1.7e-3,
                "residual": 0.21,
                "seconds_left": 6.5,
                "updated_at": "2026-05-04T09:30:05Z",
            },
        }
    }
}

_FILE = {"type": "string", "format": "binary"}
SUBMIT_BODY: dict[str, Any] = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "anyOf": [{"required": ["tracks"]}, {"required": ["tracks_upload"]}],
                "properties": {
                    "tracks": {
                        **_FILE,
                        "description": "The 2-D tracks: npz with `tracks (F, P, 2)` and optionally `visibility (F, P)`, "
                        "or another layout that docs/reference/formats.md lists.",
                    },
                    "mesh": {
                        "anyOf": [_FILE, {"type": "string", "pattern": "^([0-9]{1,6}x[0-9]{1,6}|none)$"}],
                        "description": "A mesh file whose vertex i is point i, or the text ROWSxCOLUMNS for a pixel grid. "
                        "Left out: one is made, and the report says how.",
                    },
                    "ground_truth": {**_FILE, "description": "npz with `shapes (F, P, 3)`; used for metrics alone."},
                    "rotations": {
                        **_FILE,
                        "description": "Known cameras `(F, 3, 3)` or `(F, 2, 3)`, used as they are.",
                    },
                    "options": {"type": "string", "description": "A JSON object; its schema is at /v1/options."},
                    "name": {"type": "string", "maxLength": 200, "description": "A label of your own."},
                    "webhook": {
                        "type": "string",
                        "format": "uri",
                        "maxLength": 2000,
                        "description": "An http(s) address that gets a POST once the job has ended, signed as Standard Webhooks 1.0 says.",
                    },
                    "webhook_secret": {
                        "type": "string",
                        "pattern": "^whsec_[A-Za-z0-9+/=]{32,}$",
                        "description": "The key of that signature: `whsec_` and 24 to 64 random bytes in base64. Goes with `webhook`.",
                    },
                    **{
                        f"{part}_upload": {
                            "type": "string",
                            "description": f"Id of an upload (`PUT /v1/uploads/ID`) that stands for the part `{part}`.",
                        }
                        for part in ("tracks", "mesh", "ground_truth", "rotations")
                    },
                },
            },
            "encoding": {
                "tracks": {"contentType": "application/octet-stream"},
                "options": {"contentType": "application/json"},
            },
            "example": {"tracks": "(the bytes of tracks.npz)", "mesh": "38x38", "options": '{"method": "robust"}'},
        }
    },
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entries of these error statuses."""
    return {status: _problem(status) for status in statuses}


def _problem(status: int) -> dict[str, Any]:
    shown = {"example": _PROBLEM_EXAMPLE} if status == 422 else {}
    entry: dict[str, Any] = {
        "description": HTTPStatus(status).phrase,
        "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}, **shown}},
    }
    if status in _SAID_IN_HEADERS:
        name, meaning = _SAID_IN_HEADERS[status]
        entry["headers"] = {name: {"description": meaning, "schema": {"type": "string"}}}
    return entry


_SAID_IN_HEADERS = {
    401: ("WWW-Authenticate", "How to authenticate (RFC 6750)."),
    429: ("Retry-After", "Seconds to wait."),
    503: ("Retry-After", "Seconds to wait."),
}
_FROM_THE_GUARD = (421, 500)
"""What any address may answer: a Host that is not this service's, a defect."""
_FROM_THE_DOOR = (401, 403, 429, 503)
"""What any address that is not public may answer: no token, not one that may, too often, no store to look the token up."""


def document(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document, made once: FastAPI's, and what is answered before a route is reached."""
    if app.openapi_schema is None:
        made = FastAPI.openapi(app)
        schemas = made.setdefault("components", {}).setdefault("schemas", {})
        for path, operations in made["paths"].items():
            for operation in operations.values():
                _complete(operation, path)
        schemas["Problem"] = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
        for name in ("HTTPValidationError", "ValidationError"):  # FastAPI's own, which nothing here answers with
            schemas.pop(name, None)
        said = "Where the service asks for tokens. Whoever runs it makes them with `pliant token create`."
        made["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer", "description": said}}
        app.openapi_schema = made
    return app.openapi_schema


def _complete(operation: dict[str, Any], path: str) -> None:
    """Add to an operation what is true of all, and make every error a problem."""
    open_to_all = is_public(path)
    operation["security"] = [] if open_to_all else [{"token": []}]
    responses = operation["responses"]
    if "422" in responses:
        responses["422"] = _problem(422)
    usual: tuple[int, ...] = _FROM_THE_GUARD if open_to_all else _FROM_THE_GUARD + _FROM_THE_DOOR
    if "{" in path:
        usual += (404,)
    for status in usual:
        responses.setdefault(str(status), _problem(status))
    operation["responses"] = dict(sorted(responses.items()))

"""The parts of the OpenAPI document that FastAPI cannot derive from the code: errors, examples, tags, the form."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from fastapi import FastAPI
from pliant.schemas.job import LONGEST_NAME, Problem
from pliant.schemas.options import Options
from pliant.schemas.outputs import OutputRequest
from pliant.schemas.problems import ProblemCode, type_of
from pliant.schemas.shares import ShareRequest
from pliant.service.middleware.auth import is_public
from pliant.service.middleware.origin import FOR_MACHINES
from pliant.service.problems import MEDIA_TYPE

SUMMARY = "Films, or dense 2-D point tracks, of a deforming object in, a moving 3-D mesh out."
DESCRIPTION = """Submit a job with `POST /v1/jobs`, follow it, download its files.

Every error is `application/problem+json` (RFC 9457) with a stable `code`, a `type` that links to its explanation, a `detail` that
ends with what to do and, for a wrong input, `field`, `expected`, `got` and `hint`. `retryable` is true if the same request can
succeed later. Every answer has an `X-Request-ID`, which is also in the service's log.
"""

TAGS = [
    {"name": "jobs", "description": "Submit, follow, cancel, retry and delete reconstructions."},
    {"name": "artifacts", "description": "Download result files, whole or in ranges."},
    {
        "name": "uploads",
        "description": "Send inputs above 32 MB, or over unreliable connections; interrupted uploads resume.",
    },
    {"name": "about", "description": "Options, limits, examples, error codes, health and metrics of this service."},
]


_PROBLEM_EXAMPLE = {
    "type": type_of("too_few_frames"),
    "title": ProblemCode.TOO_FEW_FRAMES.heading,
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
                # Tracks, an upload of tracks, a film, or the inputs of an earlier job are required.
                # Client generators do not support an anyOf here.
                "if": {
                    "not": {
                        "anyOf": [
                            {"required": [part]} for part in ("tracks_upload", "film", "film_upload", "inputs_of")
                        ]
                    }
                },
                "then": {"required": ["tracks"]},
                "properties": {
                    "tracks": {
                        **_FILE,
                        "description": "The 2-D tracks: npz with `tracks (F, P, 2)` and optionally `visibility (F, P)`, "
                        "or the output of a point tracker; the documentation lists all formats.",
                    },
                    "film": {
                        **_FILE,
                        "description": "Instead of tracks: an mp4, mov, webm, mkv or avi film, an animated GIF, or a zip of pictures. "
                        "Its points are tracked when the job runs; large films are better sent as an upload.",
                    },
                    "region": {
                        **_FILE,
                        "description": "What to track in the film: a mask picture of its size, white inside. Omitted: the option "
                        "`region_polygon`, or the whole picture.",
                    },
                    "mesh": {
                        "anyOf": [_FILE, {"type": "string", "pattern": "^([0-9]{1,6}x[0-9]{1,6}|none)$"}],
                        "description": "A mesh file whose vertex i is point i, or the text ROWSxCOLUMNS for a pixel grid. "
                        "Omitted: a mesh is triangulated from the tracks, as the report describes.",
                    },
                    "ground_truth": {**_FILE, "description": "npz with `shapes (F, P, 3)`; used only for metrics."},
                    "rotations": {
                        **_FILE,
                        "description": "Known cameras `(F, 3, 3)` or `(F, 2, 3)`, used as they are.",
                    },
                    "options": {
                        "type": "string",
                        "contentMediaType": "application/json",
                        "contentSchema": {"$ref": "#/components/schemas/Options"},
                        "description": "A JSON object, also described at /v1/options.",
                    },
                    "inputs_of": {
                        "type": "string",
                        "description": "Instead of files: the id of one of your jobs, whose inputs are used again with these options. "
                        "Options that determine how tracks were read, or how a film is tracked, are those of that job; for a film "
                        "they may be given again.",
                    },
                    "name": {"type": "string", "maxLength": LONGEST_NAME, "description": "A label of your own."},
                    "webhook": {
                        "type": "string",
                        "format": "uri",
                        "maxLength": 2000,
                        "description": "URL that receives a POST once the job has ended, signed as in Standard Webhooks 1.0.",
                    },
                    "priority": {
                        "type": "string",
                        "enum": ["high", "normal", "low"],
                        "description": "Order among your own waiting jobs; `normal` where it is absent.",
                    },
                    "webhook_secret": {
                        "type": "string",
                        "pattern": "^whsec_[A-Za-z0-9+/=]{32,}$",
                        "description": "Key of the signature: `whsec_` and 24 to 64 random bytes in base64. Required with `webhook`.",
                    },
                    **{
                        f"{part}_upload": {
                            "type": "string",
                            "description": f"Id of a complete upload (`PUT /v1/uploads/ID`) to use as the part `{part}`.",
                        }
                        for part in ("film", "region", "tracks", "mesh", "ground_truth", "rotations")
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


_REF = "#/components/schemas/{model}"


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entries of these error statuses."""
    return {status: _problem(status) for status in statuses}


def _problem(status: int) -> dict[str, Any]:
    shown = {"example": _PROBLEM_EXAMPLE} if status == 422 else {}
    entry: dict[str, Any] = {
        "description": HTTPStatus(status).phrase,
        "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}, **shown}},
    }
    if status in _ERROR_HEADERS:
        name, meaning = _ERROR_HEADERS[status]
        entry["headers"] = {name: {"description": meaning, "schema": {"type": "string"}}}
    return entry


_ERROR_HEADERS = {
    401: ("WWW-Authenticate", "How to authenticate (RFC 6750)."),
    429: ("Retry-After", "Seconds to wait."),
    503: ("Retry-After", "Seconds to wait."),
}
_WITH_TOKEN = {401, 403, 429, 503}
"""Further errors of paths that need a token: missing or invalid token, missing scope, rate limit, unavailable token store."""


def document(app: FastAPI) -> dict[str, Any]:
    """Return FastAPI's OpenAPI document, with the errors of middleware and the schemas that routes only refer to."""
    if app.openapi_schema is None:
        made = FastAPI.openapi(app)
        schemas = made.setdefault("components", {}).setdefault("schemas", {})
        for path, operations in made["paths"].items():
            for operation in operations.values():
                _complete(operation, path)
        schemas["Problem"] = Problem.model_json_schema(ref_template=_REF)
        schemas["Problem"]["properties"]["code"] = {
            "$ref": _REF.format(model="ProblemCode"),
            "description": "Stable machine-readable name of the error.",
        }
        schemas["ProblemCode"] = {
            "title": "ProblemCode",
            "type": "string",
            "enum": [code.value for code in ProblemCode],
        }
        # The schema of a request, in which every option may be omitted.
        schemas["Options"] = Options.model_json_schema(ref_template=_REF)
        for model in (OutputRequest, ShareRequest):
            schemas[model.__name__] = model.model_json_schema(ref_template=_REF)
        # FastAPI's own error format, which this service never uses.
        for name in ("HTTPValidationError", "ValidationError"):
            schemas.pop(name, None)
        text = "Required unless tokens are off. The operator creates tokens with `pliant token create`."
        made["components"]["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer", "description": text}}
        app.openapi_schema = made
    return app.openapi_schema


def _complete(operation: dict[str, Any], path: str) -> None:
    """Add the security and the errors that all operations share."""
    open_to_all = is_public(path.replace("{code}", ""))
    operation["security"] = [] if open_to_all else [{"token": []}]
    responses = operation["responses"]
    if "422" in responses:
        responses["422"] = _problem(422)
    usual = {500}
    if path not in FOR_MACHINES:  # these accept every Host
        usual.add(421)
    if not open_to_all:
        usual |= _WITH_TOKEN
    if "{" in path:
        usual.add(404)
    if path.startswith("/v1/"):
        usual.add(422)  # an unknown query parameter
    for status in usual:
        responses.setdefault(str(status), _problem(status))
    operation["responses"] = dict(sorted(responses.items()))

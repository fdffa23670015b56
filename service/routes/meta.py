"""The service itself: options, limits, health."""

from __future__ import annotations

import dataclasses
import logging
from typing import Annotated, Any, Literal

from fastapi import Query
from pliant.schemas.job import LARGEST_PAGE, ServiceLimits
from pliant.schemas.options import Options
from pliant.schemas.problems import ProblemCode
from pliant.service.dependencies import Bound, Core
from pliant.service.openapi import problems
from pliant.service.problems import Refusal
from pliant.service.routes.router import Router

router = Router(tags=["about"])

Part = Literal["redis", "blobs", "workers"]

_log = logging.getLogger("pliant.service")


@router.get("/v1/options", operation_id="get_options", summary="The options of a job", responses=problems(401))
def options() -> dict[str, Any]:
    """Return the JSON Schema of `options`: every option with its meaning, unit, bounds and default."""
    return Options.model_json_schema()


@router.get("/v1/limits", operation_id="get_limits", summary="What this service accepts", responses=problems(401))
def limits(core: Core, bounds: Bound) -> ServiceLimits:
    """Return the limits on bodies, frames, points, queued jobs and requests that apply to the request's token."""
    taken = {field.name for field in dataclasses.fields(core.limits)} & set(ServiceLimits.model_fields)
    return ServiceLimits(
        **{name: getattr(core.limits, name) for name in taken},
        **dataclasses.asdict(bounds),
        max_text_bytes=core.settings.max_text_bytes,
        max_wait_seconds=core.settings.max_wait_seconds,
        max_page=LARGEST_PAGE,
    )


@router.get("/healthz", operation_id="get_health", summary="Liveness: the process answers")
async def healthz() -> dict[str, str]:
    """Return 200 while the process responds. It checks nothing else and does not wait for a thread."""
    return {"status": "ok"}


@router.get(
    "/readyz", operation_id="get_readiness", summary="Readiness: all parts answer", responses=problems(422, 503)
)
def readyz(
    core: Core, exclude: Annotated[list[Part] | None, Query(description="Parts to leave out; can be repeated.")] = None
) -> dict[str, str]:
    """Return 200 if the job store, the blob store and at least one worker respond, else 503 with the parts that do not.

    To probe only the API process, use `?exclude=workers`: without a worker it still accepts jobs and serves results.
    If tokens are required, the response contains no reasons; they are in the service's log.
    """
    parts = {name: state for name, state in core.jobs.ready().items() if name not in (exclude or ())}
    missing = {name: state for name, state in parts.items() if state != "ok"}
    if not missing:
        return parts
    detail = " ".join(f"{name}: {sentence}" for name, sentence in missing.items())
    if core.settings.asks_for_tokens:
        # While no worker runs yet, the answer itself says so, and a start is no reason for a warning.
        _log.log(logging.INFO if set(missing) == {"workers"} else logging.WARNING, "not ready: %s", detail)
        detail = f"Not ready: {', '.join(missing)}. The service's log has the reasons."
    raise Refusal(ProblemCode.NOT_READY, detail=detail, headers={"Retry-After": "2"})

"""What the service is and how it is: options, limits, health."""

from __future__ import annotations

import dataclasses
import logging
from typing import Any

from fastapi import APIRouter
from fastapi.responses import JSONResponse, Response
from pliant.schemas.job import ServiceLimits
from pliant.schemas.options import Options
from pliant.service.dependencies import Bound, Core
from pliant.service.openapi import problems
from pliant.service.problems import answer, problem
from pliant.worker.jobs.service import LARGEST_PAGE

router = APIRouter(tags=["about"])

_log = logging.getLogger("pliant.service")


@router.get("/v1/options", summary="The options of a job", responses=problems(401))
def options() -> dict[str, Any]:
    """Return the JSON Schema of `options`: every name with its meaning, unit, bounds and default."""
    return Options.model_json_schema()


@router.get("/v1/limits", summary="What this service accepts", responses=problems(401))
def limits(core: Core, bounds: Bound) -> ServiceLimits:
    """Return the largest body, frames, points and the like, for the token that asks."""
    taken = {field.name for field in dataclasses.fields(core.limits)} & set(ServiceLimits.model_fields)
    return ServiceLimits(
        **{name: getattr(core.limits, name) for name in taken},
        **dataclasses.asdict(bounds),
        max_text_bytes=core.settings.max_text_bytes,
        max_wait_seconds=core.settings.max_wait_seconds,
        max_page=LARGEST_PAGE,
    )


@router.get("/healthz", summary="Is the process alive?")
async def healthz() -> dict[str, str]:
    """Return 200 while the process answers at all; nothing else is looked at, and no thread is waited for."""
    return {"status": "ok"}


@router.get("/readyz", summary="Can it take jobs?", responses=problems(503))
def readyz(core: Core) -> Response:
    """Return 200 if the job store, the blob store and at least one worker are there, else 503 and what is missing.

    Where tokens are asked for, strangers are told which part is missing and not why; the service's log says that.
    """
    parts = core.jobs.ready()
    missing = {name: said for name, said in parts.items() if said != "ok"}
    if not missing:
        return JSONResponse(parts)
    said = " ".join(f"{name}: {sentence}" for name, sentence in missing.items())
    if core.settings.asks_for_tokens:
        _log.warning("not ready: %s", said)
        said = f"Not ready: {', '.join(missing)}. The service's log says why."
    return answer(problem(503, "not_ready", detail=said), headers={"Retry-After": "2"})

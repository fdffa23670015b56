"""Metrics for the operator."""

from __future__ import annotations

from fastapi.responses import PlainTextResponse, Response
from pliant.service.dependencies import Core
from pliant.service.metrics import MEDIA_TYPE
from pliant.service.openapi import problems
from pliant.service.routes.router import Router

router = Router(tags=["about"])

_TEXT = {
    "text/plain": {
        "schema": {"type": "string"},
        "example": '# TYPE pliant_jobs gauge\npliant_jobs{status="queued"} 3\n',
    }
}


@router.get(
    "/metrics",
    operation_id="get_metrics",
    summary="Metrics for Prometheus",
    response_class=PlainTextResponse,
    responses={200: {"content": _TEXT}, **problems(401, 403)},
)
def metrics(core: Core) -> Response:
    """Return metrics of jobs, queue, workers, files, webhooks and requests. If tokens are required, the scope `admin` is needed."""
    return Response(core.metrics.exposition(core.jobs), media_type=MEDIA_TYPE)

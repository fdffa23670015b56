"""Inspect: how files would be understood, before a job is made of them."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter, Request
from pliant.schemas.job import Inspection
from pliant.service.dependencies import Bound, Core, MyUploads
from pliant.service.multipart import Form, receive_form
from pliant.service.openapi import SUBMIT_BODY, problems
from pliant.service.sample import sample_of
from pliant.service.submission import form_rules, parse_options, read_form, with_uploads
from pliant.worker.formats import Limits, load_inputs
from pliant.worker.formats.isolated_reader import LARGE
from pliant.worker.uploads.service import Uploads

router = APIRouter(prefix="/v1/inspect", tags=["jobs"])


@router.post(
    "",
    summary="Say how files would be understood",
    responses=problems(400, 401, 403, 408, 413, 415, 422, 429, 503, 507),
    openapi_extra={"requestBody": SUBMIT_BODY},
)
async def inspect(request: Request, core: Core, bounds: Bound, uploads: MyUploads) -> Inspection:
    """Read the parts of a job as `POST /v1/jobs` would, and return the interpretation without making a job.

    What submitting refuses is refused here in the same words, with the readings to choose from where several fit. Nothing is kept.
    """
    rules = form_rules(core.settings, max_body_bytes=bounds.max_body_bytes)
    with core.incoming.room() as room:
        form = await receive_form(request, room, rules=rules)
        return await core.parsing.run(uploads.owner, lambda: understood(form, room, uploads, core.limits))


def understood(form: Form, room: Path, uploads: Uploads, limits: Limits) -> Inspection:
    """Read a form as for a job, and forget all but how it was understood. Blocks; call it on a thread."""
    whole, canonical = with_uploads(form, room, uploads), room / "canonical.npz"
    said = read_form(whole, parse_options(whole.texts.get("options", "")), limits, target=canonical)
    # What is too large to be read in this process is too large to be looked at in it.
    sample = sample_of(load_inputs(canonical)) if canonical.stat().st_size <= LARGE else []
    return Inspection(**said.model_dump(), sample=sample)

"""Inspection: how files would be interpreted, without creating a job."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fastapi import APIRouter, Request
from numpy.typing import NDArray
from pliant.schemas.job import Inspection
from pliant.schemas.problems import ProblemCode
from pliant.service.dependencies import Bound, Core, MyUploads, Service
from pliant.service.multipart import Form, receive_form
from pliant.service.openapi import SUBMIT_BODY, problems
from pliant.service.problems import wrong_input
from pliant.service.submission import KEPT, form_rules, parse_options, read_form, with_uploads
from pliant.worker.films.bounds import FilmBounds
from pliant.worker.formats import Inputs, load_inputs
from pliant.worker.formats.isolated_reader import LARGE
from pliant.worker.uploads.service import Uploads

router = APIRouter(prefix="/v1/inspect", tags=["jobs"])

SAMPLE_FRAMES, SAMPLE_POINTS = 16, 200
"""Maximum numbers of frames and points in a sample."""
BOX = 1000
"""Side of the square to which a sample's coordinates are scaled."""
NOT_SEEN = -1


@router.post(
    "",
    operation_id="inspect_inputs",
    summary="Inspect inputs without creating a job",
    responses=problems(400, 401, 403, 408, 413, 415, 422, 429, 503, 507),
    openapi_extra={"requestBody": SUBMIT_BODY},
)
async def inspect(request: Request, core: Core, bounds: Bound, uploads: MyUploads) -> Inspection:
    """Read the parts of a job as `POST /v1/jobs` would, and return the interpretation without creating a job.

    Inputs and options that a submission would refuse are refused with the same problem, including `choices`. Limits that depend on the
    workers and on the owner are not checked: `estimate` states the memory that the job needs. Nothing is stored. `inputs_of` is
    refused: the interpretation of an earlier job's inputs is in its record.
    """
    rules = form_rules(core.settings, max_body_bytes=bounds.max_body_bytes)
    async with core.incoming.scratch() as folder:
        form = await receive_form(request, folder, rules=rules)
        return await core.parsing.run(uploads.owner, lambda: interpret(form, folder, uploads, core))


def interpret(form: Form, folder: Path, uploads: Uploads, core: Service) -> Inspection:
    """Read a form as for a job, and return the interpretation with a sample or a first frame. Blocks; call it on a thread."""
    if form.texts.get(KEPT, "").strip():
        hint = "Read the `interpretation` of that job's record instead."
        raise wrong_input(ProblemCode.UNKNOWN_PART, field=KEPT, expected="files", got="an earlier job", hint=hint)
    whole, canonical = with_uploads(form, folder, uploads), folder / "canonical.npz"
    films = FilmBounds.of(core.jobs.settings, max_bytes=core.limits.max_bytes)
    options = parse_options(whole.texts.get("options", ""))
    threads = core.jobs.settings.threads_per_job
    read = read_form(whole, options, core.limits, films=films, target=canonical, threads=threads)
    # Inputs too large to be parsed in this process are too large to be sampled in it.
    tracked = "film" not in whole.files and canonical.stat().st_size <= LARGE
    sample = sample_of(load_inputs(canonical)) if tracked else []
    return Inspection(**read.interpretation.model_dump(), sample=sample, first_frame=read.first_frame)


def sample_of(inputs: Inputs) -> list[list[int]]:
    """Return evenly spaced frames and points as integer coordinates in a square, as a small sample for a picture.

    One list per frame: x and y of each point in turn, 0 … `BOX`, x right, y down, with one scale for both axes; `NOT_SEEN` twice
    for a point that is hidden or outside the square.
    """
    points, visible = inputs.tracks.points, inputs.tracks.visible
    frames, chosen = evenly(len(points), SAMPLE_FRAMES), evenly(points.shape[1], SAMPLE_POINTS)
    some = points[np.ix_(frames, chosen)] * (1.0, -1.0 if inputs.interpretation.y_axis == "up" else 1.0)
    seen = visible[np.ix_(frames, chosen)] > 0
    if not seen.any():
        return [[NOT_SEEN] * (2 * len(chosen))] * len(frames)
    # The 1st and 99th percentiles determine the scale, so that a gross outlier does not shrink the rest to a dot.
    low, high = np.percentile(some[seen], (1, 99), axis=0)
    scale = 0.9 * BOX / max(float((high - low).max()), np.finfo(float).tiny)
    placed = BOX / 2 + scale * (some - (low + high) / 2)
    inside = seen & ((placed >= 0) & (placed <= BOX)).all(axis=2)
    return [[int(value) for value in frame.ravel()] for frame in np.where(inside[..., None], placed.round(), NOT_SEEN)]


def evenly(count: int, most: int) -> NDArray[np.intp]:
    """Return at most `most` indices, evenly spread over 0 … count − 1 and including both ends."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.intp))

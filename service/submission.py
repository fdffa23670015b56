"""From a received form to a queued job: read, validate, store in canonical form, submit. Nothing is queued before all checks pass."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from pliant.schemas.job import LONGEST_NAME, Interpretation, Job, Priority
from pliant.schemas.options import Options
from pliant.schemas.problems import ProblemCode
from pliant.schemas.suggestions import closest
from pliant.schemas.validation import alternatives
from pliant.service.multipart import File, Form, FormRules, own_name
from pliant.service.problems import Refusal, from_validation, wrong_input
from pliant.service.settings import ServiceSettings
from pliant.worker.artifacts import kinds_for
from pliant.worker.errors import Conflict, UnknownJob, UnknownUpload
from pliant.worker.films.bounds import FilmBounds
from pliant.worker.films.sources import FilmSource, is_source, open_source, save_source
from pliant.worker.films.tracker import TRACKING_OPTIONS, read_film, with_estimate
from pliant.worker.formats import InvalidInput, Limits, store_inputs
from pliant.worker.formats.cost import estimated
from pliant.worker.formats.isolated_reader import check_stored
from pliant.worker.formats.point_names import one_line
from pliant.worker.formats.tracks.film_tracks import tracks_options
from pliant.worker.formats.tracks.pixels import FRACTIONS
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.uploads.service import Uploads
from pliant.worker.webhooks.message import parse_webhook
from pydantic import ValidationError

OF_TRACKS = ("tracks", "mesh", "ground_truth", "rotations")
OF_FILM = ("film", "region")
FILES = frozenset({*OF_TRACKS, *OF_FILM})
UPLOADS = {f"{part}_upload": part for part in sorted(FILES)}
"""Text parts with the id of an upload, and the file part that each replaces."""
KEPT = "inputs_of"
"""Text part with the id of a job whose stored inputs are reused."""
TEXTS = frozenset({"mesh", "options", "name", "priority", "webhook", "webhook_secret", KEPT, *UPLOADS})
ANY_INPUT = frozenset({"file", "files", "data", "input", "upload", "video", "points"})
"""Common names of a part that holds the tracks or the film."""
READING = (
    "layout", "rows", "y_axis", "coordinates", "coordinate_order", "visibility", "frames", "stride", "max_points", "min_seen",
)  # fmt: skip
"""Options that determine how tracks are read; they cannot change for stored inputs, which have been read already."""
OF_TRACKING = (*sorted(TRACKING_OPTIONS), "stride", "max_points", "min_seen")
"""Options that determine the tracks of a film; those of an earlier job are kept unless they are given again."""


def form_rules(settings: ServiceSettings, *, max_body_bytes: int) -> FormRules:
    """Return the rules for the form of a job; `max_body_bytes` is the limit of the request's token."""
    return FormRules(
        files=FILES,
        texts=TEXTS,
        max_body_bytes=max_body_bytes,
        max_text_bytes=settings.max_text_bytes,
        stall_seconds=settings.stall_seconds,
        hint=hint_of_unknown,
    )


def hint_of_unknown(part: str) -> str:
    """Return what to do about a part of an unknown name: an option, another word for the input, or a misspelt name."""
    if part in Options.model_fields:
        return f"It is an option: send it in the part options, as in curl's -F 'options={{\"{part}\": …}}'."
    if part in ANY_INPUT:
        return "Name the part tracks or film, as in curl's -F tracks=@tracks.npz or -F film=@film.mp4."
    meant = closest(part, sorted(FILES | TEXTS))
    return "Leave it out." if meant is None else f"Did you mean {meant}? If not, leave it out."


def accept(
    form: Form,
    folder: Path,
    *,
    jobs: Jobs,
    uploads: Uploads,
    limits: Limits,
    id: str | None = None,
    idempotency_key: str | None = None,
) -> tuple[Job, bool]:
    """Read a form's inputs and submit the job; return it, and whether it is new. Blocks; call it on a thread.

    The canonical inputs are written to `folder`, which the caller removes. `limits` bounds the inputs that the readers accept.

    Raises
    ------
    Refusal, InvalidInput, WorkerError
        The job was refused; nothing is queued.
    """
    form = with_uploads(form, folder, uploads)
    fingerprint = form.fingerprint
    options = parse_options(form.texts.get("options", ""))
    name = _name(form.texts.get("name", ""))
    webhook = parse_webhook(
        form.texts.get("webhook", "").strip(),
        form.texts.get("webhook_secret", "").strip(),
        networks=jobs.settings.webhook_networks,
    )
    submission = Submission(
        options=options, name=name, id=id, idempotency_key=idempotency_key, fingerprint=fingerprint, webhook=webhook,
        priority=_priority(form.texts.get("priority", "")),
    )  # fmt: skip
    known = jobs.known(submission)
    if known is not None:
        return known, False
    kept = kept_inputs(form, options, folder, jobs)
    if kept is not None:
        form, options, submission = kept.form, kept.options, replace(submission, name=name or kept.job.name)
    if kept is not None and kept.canonical is not None:
        canonical = kept.canonical
        read = _read_again(kept.job.interpretation, canonical, options, limits)
    else:
        canonical = folder / "canonical.npz"
        films = FilmBounds.of(jobs.settings, max_bytes=limits.max_bytes)
        read = read_form(form, options, limits, films=films, target=canonical)
    return jobs.submit(canonical, replace(submission, options=read.options), interpretation=read.interpretation)


@dataclass(frozen=True)
class Kept:
    """The stored inputs of an earlier job, for reuse."""

    job: Job
    form: Form
    """The form, with the earlier job's film if it had one."""
    options: Options
    """The given options; those of `reading_options` (tracks) and `OF_TRACKING` (films) are the earlier job's."""
    canonical: Path | None
    """The tracks as they were read; None for a film, which is tracked again."""


def kept_inputs(form: Form, options: Options, folder: Path, jobs: Jobs) -> Kept | None:
    """Return the stored inputs of the job in the form's part `inputs_of`; None if the form has no such part.

    Raises
    ------
    Refusal
        There is no such job, the form has files as well, or an option differs from how the stored tracks were read.
    NotAllowedNow
        The job only wrote further files of another one.
    """
    id = form.texts.get(KEPT, "").strip()
    if not id:
        return None
    others = sorted({*form.files, *(("mesh",) if form.texts.get("mesh", "").strip() else ())})
    if others:
        raise wrong_input(
            ProblemCode.CONFLICTING_PARTS, field=KEPT, expected="either inputs_of or files", got=f"inputs_of and {', '.join(others)}",
            hint="Leave one of them out.",
        )  # fmt: skip
    try:
        job, file = jobs.kept_inputs(id, folder / "kept.npz")
    except UnknownJob as error:
        raise Refusal(
            ProblemCode.UNKNOWN_JOB, detail=str(error), field=KEPT, expected="the id of one of your jobs", got=repr(id[:80]),
            hint="List your jobs to see which exist; expired ones are removed.",
        ) from error  # fmt: skip
    if is_source(file):
        source = open_source(file, folder / "kept")
        files = {
            part: File(
                path, path.stat().st_size, hashlib.sha256(f"{id} {part}".encode()).hexdigest(), source.names[part]
            )
            for part, path in (("film", source.film), ("region", None if options.region_polygon else source.region))
            if path is not None
        }
        had = {name: getattr(job.options, name) for name in OF_TRACKING if name not in options.model_fields_set}
        return Kept(job, Form(files=files, texts={**form.texts, KEPT: id}), options.model_copy(update=had), None)
    fixed = reading_options(job.interpretation)
    for name in fixed:
        wanted, had = getattr(options, name), getattr(job.options, name)
        if name in options.model_fields_set and wanted != had:
            kept = "no value" if had is None else repr(had)
            raise wrong_input(
                ProblemCode.CONFLICTING_PARTS, field=f"options.{name}", expected=f"{kept}, as the inputs of job {id!r} were read",
                got=repr(wanted), hint="Send the files again to read them in another way.",
            )  # fmt: skip
    had = {name: getattr(job.options, name) for name in fixed}
    return Kept(job, form, options.model_copy(update=had), file)


def reading_options(interpretation: Interpretation) -> tuple[str, ...]:
    """Return the options that determined how tracks were read: `READING`, and `image_size` if it converted fractions to pixels."""
    return (*READING, "image_size") if interpretation.coordinates in FRACTIONS else READING


def with_uploads(form: Form, folder: Path, uploads: Uploads) -> Form:
    """Return the form with its uploads as files, so that its fingerprint does not depend on how the files were sent.

    Raises
    ------
    Refusal
        There is no such upload, it is not complete, or the form contains the part as well.
    """
    files, texts = dict(form.files), dict(form.texts)
    for name, part in UPLOADS.items():
        if name not in form.texts:
            continue
        id, path = texts.pop(name).strip(), folder / name
        if part in files or part in texts:
            raise wrong_input(
                ProblemCode.REPEATED_PART,
                field=name,
                expected=f"either {part} or {name}",
                got="both",
                hint="Leave one of them out.",
            )
        try:
            digest = uploads.take(id, path)
        except UnknownUpload as error:
            hint = f"PUT it to /v1/uploads/{id[:64]} first; uploads that are not used expire."
            code = ProblemCode(error.code)
            raise wrong_input(
                code, field=name, status=422, expected="the id of an upload", got=repr(id[:80]), hint=hint
            ) from error
        except Conflict as error:
            hint = "Send the rest first, from the offset that HEAD returns."
            code = ProblemCode(error.code)
            raise wrong_input(
                code, field=name, status=422, expected="a complete upload", got="an incomplete one", hint=hint
            ) from error
        files[part] = File(path, path.stat().st_size, digest, own_name(texts.get("name", "")) if part == "film" else "")
    return Form(files=files, texts=texts)


@dataclass(frozen=True, slots=True)
class ReadInputs:
    """The interpretation of a form's files."""

    interpretation: Interpretation
    options: Options
    """The given options, completed with values from the film or track file."""
    first_frame: str | None = None
    """First frame of a film, as a JPEG in base64; None for tracks, or if it was not requested."""


def read_form(
    form: Form, options: Options, limits: Limits, *, films: FilmBounds, target: Path, threads: int = 0
) -> ReadInputs:
    """Read, check and interpret the files of a form, and store them in the file `target`. Blocks; call it on a thread.

    A film is only opened, not tracked; with the number of `threads` of a job, its first frame and its estimate are returned, too.

    Raises
    ------
    Refusal, InvalidInput
        A part is missing, contradicts another one, or cannot be read.
    """
    is_film = any(part in form.files for part in OF_FILM)
    if is_film:
        _check_film_parts(form)
    elif "tracks" not in form.files:
        raise missing("tracks")
    kinds_for(options)  # refuses outputs that this installation cannot write
    if is_film:
        return _read_film(form, options, films, target, threads=threads)
    files: dict[str, Path | str | None] = {part: file.path for part, file in form.files.items()}
    if form.texts.get("mesh", "").strip():
        files["mesh"] = form.texts["mesh"].strip()
    interpretation = store_inputs(**files, options=options, limits=limits, target=target)  # type: ignore[arg-type]
    return ReadInputs(interpretation, tracks_options(options, interpretation))


def _read_again(interpretation: Interpretation, canonical: Path, options: Options, limits: Limits) -> ReadInputs:
    """Return the interpretation of tracks that an earlier job has read, updated for the options of a new solve."""
    size = (interpretation.num_frames, interpretation.num_points)
    kinds_for(options, size=size)
    options = tracks_options(options, interpretation)
    check_stored(canonical, options, limits)
    estimate = estimated(*size, options, has_rotations=interpretation.has_rotations)
    return ReadInputs(interpretation.model_copy(update={"estimate": estimate}), options)


def _check_film_parts(form: Form) -> None:
    """Refuse a region without a film, and a film together with parts that belong to tracks."""
    if "film" not in form.files:
        raise missing("film")
    others = [part for part in OF_TRACKS if part in form.files or form.texts.get(part, "").strip()]
    if others:
        raise wrong_input(
            ProblemCode.CONFLICTING_PARTS,
            field=others[0],
            expected="a film with its region, or tracks with what belongs to them",
            got=f"film and {', '.join(others)}",
            hint="Leave one of them out: the tracks and the mesh of a film are made from it.",
        )


def _read_film(form: Form, options: Options, bounds: FilmBounds, target: Path, *, threads: int) -> ReadInputs:
    region = form.files.get("region")
    source = FilmSource(
        form.files["film"].path, None if region is None else region.path, film_name=form.files["film"].name or "the film",
        region_name="the region" if region is None else region.name or "the region",
        own_rate="fps" in options.model_fields_set,
    )  # fmt: skip
    read = read_film(source, options, bounds, picture=threads > 0)
    if threads > 0:
        with suppress(InvalidInput):  # a submission of this film is accepted: it decodes less
            read = with_estimate(read, source, bounds, threads=threads)
    save_source(source, read.interpretation, target)
    return ReadInputs(read.interpretation, read.options, read.facts.first_frame or None)


def missing(part: str) -> Refusal:
    """Return the refusal of a form without a required part."""
    if part == "film":
        hint = "A region belongs to a film: add it, as in curl's -F film=@film.mp4."
    else:
        hint = f"Add the part, as in curl's -F {part}=@{part}.npz, or a film: -F film=@film.mp4."
    return wrong_input(ProblemCode.MISSING_PART, field=part, expected="a file", got="none", hint=hint)


def parse_options(text: str) -> Options:
    """Return the options of a job from their JSON; empty text means the defaults.

    Raises
    ------
    Refusal
        The text is not a JSON object, an option is unknown, or a value is invalid.
    """
    if not text.strip():
        return Options()
    try:
        given: Any = json.loads(text)
    except (ValueError, RecursionError):
        raise _not_an_object("text that is not JSON") from None
    if not isinstance(given, dict):
        raise _not_an_object(JSON_KINDS[type(given)])
    try:
        return Options.model_validate(given)
    except ValidationError as error:
        raise from_validation(error.errors(), options=True) from None


JSON_KINDS = {
    list: "a JSON list", str: "a JSON string", int: "a number", float: "a number", bool: "true or false", type(None): "null",
}  # fmt: skip
"""What JSON other than an object is called in messages."""


def _not_an_object(got: str) -> Refusal:
    hint = 'For example {"method": "robust"}; the schema is at /v1/options.'
    return wrong_input(ProblemCode.INVALID_OPTION, field="options", expected="a JSON object", got=got, hint=hint)


def _priority(text: str) -> Priority:
    """Return the priority of a job; empty text means normal."""
    given = text.strip() or "normal"
    for each in get_args(Priority):
        if given == each:
            return each  # type: ignore[no-any-return]
    code, names = ProblemCode.INVALID_PRIORITY, alternatives(get_args(Priority))
    raise wrong_input(code, field="priority", expected=names, got=repr(given[:40]), hint="Leave it out for normal.")


def _name(text: str) -> str:
    """Return the user's label with runs of blanks and control characters replaced by single spaces."""
    name = one_line(text)
    if len(name) > LONGEST_NAME:
        expected = f"at most {LONGEST_NAME} characters"
        code = ProblemCode.NAME_TOO_LONG
        raise wrong_input(code, field="name", expected=expected, got=str(len(name)), hint="Shorten it.")
    return name

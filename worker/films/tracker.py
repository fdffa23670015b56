"""Check a film, estimate the effort of tracking it, or track it, in the film process, and read its results."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, TypeVar

from pliant.schemas.job import FollowedPoints, Interpretation
from pliant.schemas.options import Options
from pliant.solver.errors import InvalidInput
from pliant.worker.errors import Interrupted
from pliant.worker.films.bounds import FilmBounds
from pliant.worker.films.sources import FilmSource
from pliant.worker.formats.cost import estimated
from pliant.worker.formats.errors import damaged, refusal_in, too_large
from pliant.worker.formats.solver_settings import solver_settings
from pliant.worker.formats.unused_options import notes_on_options
from pliant.worker.processes.contained import DONE, REFUSED, Ended, run_contained
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

MODULE = "pliant.worker.films.contained_process"
INCONSISTENT = "a film that its decoder cannot read consistently"
TRACKING_OPTIONS = {"frames", "template_frame", "grid_step", "longest_side", "region_frame", "region_polygon"}
"""Job options that the film process uses."""

Count = Annotated[int, Field(ge=0, lt=2**40)]
Words = Annotated[str, Field(max_length=1000)]


Warnings = Annotated[tuple[Words, ...], Field(max_length=100)]
WARNINGS: TypeAdapter[tuple[str, ...]] = TypeAdapter(Warnings)


class FilmFacts(BaseModel):
    """Facts about a film, from its check."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    container: Words
    width: Annotated[int, Field(ge=1, le=10**5)]
    height: Annotated[int, Field(ge=1, le=10**5)]
    fps: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
    """Frames per second of the selected frames, by the file or the times of its first frames."""

    stated_frames: Count
    """Number of frames as stated in the file; 0 if it is not stated."""

    frames: Count
    """Number of these frames that the option `frames` selects; 0 if unknown."""

    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """Playing time by the stated frames and rate; 0 if unknown."""

    rotation: Annotated[int, Field(ge=0, lt=360)]
    """Degrees clockwise by which the stored frames are turned to be upright."""

    pixel_aspect: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    """Width over height of a stored pixel; `width` and `height` count square pixels."""

    points: Count = 0
    """Estimated number of tracked points; 0 if not estimated."""

    track_seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Estimated seconds of tracking on this machine; 0 if not estimated."""

    first_frame: Annotated[str, Field(max_length=1 << 20, pattern=r"^[A-Za-z0-9+/]*={0,2}$")] = ""
    """First frame of the complete film as a JPEG in base64; empty if not requested."""


class Effort(BaseModel):
    """Expected effort of tracking a film."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    points: Count
    track_seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Tracked(BaseModel):
    """Results of tracking besides the files."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    container: Words
    fps: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
    """Frames per second, by the times of the frames used."""

    warnings: Warnings


OnWarnings = Callable[[tuple[str, ...]], None]
OnProgress = Callable[[float, tuple[int, int] | None, FollowedPoints | None], None]

MOST = 1 << 24
"""Maximum number of frames or points accepted from the film process."""


def track_film(
    source: FilmSource,
    options: Options,
    scratch: Path,
    *,
    bounds: FilmBounds = FilmBounds(),  # noqa: B008 - frozen
    threads: int = 1,
    on_progress: OnProgress | None = None,
    on_warnings: OnWarnings | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Tracked:
    """Track a film; write `tracks.npz`, `contact_sheet.jpg` and unless too large `film_frames.bin` to the empty scratch folder.

    `on_progress` receives the completed share in [0, 1], the numbers of frames and points if known, and the points just tracked,
    if any. `on_warnings` receives the warnings known so far, each time there are more. `should_stop` is called ten times a second; the
    film process is killed once it returns True.

    Raises
    ------
    InvalidInput
        The film cannot be tracked; the hint states what to change or how to film instead.
    Interrupted
        `should_stop` returned True.
    """
    _check_region(source, options)

    def on_line(stated: dict[str, Any]) -> None:
        done = stated.get("done")
        if on_progress is not None and isinstance(done, int | float) and 0 <= done <= 1:
            on_progress(float(done), believed_size(stated.get("observations")), _followed(stated.get("followed")))
        if on_warnings is not None and "warnings" in stated:
            on_warnings(believed_warnings(stated["warnings"]))

    ended = _run("track", source, options, bounds, scratch, threads=threads, on_line=on_line, should_stop=should_stop)
    if ended.stopped:
        raise Interrupted
    return _answer(Tracked, ended, bounds, bounds.track_seconds)


def believed_size(stated: object) -> tuple[int, int] | None:
    """Return the frame and point counts reported by the film process, None if invalid, since the process is not trusted."""
    match stated:
        case [int(frames), int(points)] if 0 < frames <= MOST and 0 < points <= MOST:
            return frames, points
    return None


def believed_warnings(stated: object) -> tuple[str, ...]:
    """Return the warnings reported by the film process, none if invalid."""
    try:
        return WARNINGS.validate_python(stated)
    except ValidationError:
        return ()


def _followed(stated: object) -> FollowedPoints | None:
    """Return the points reported by the film process, None if invalid."""
    try:
        return FollowedPoints.model_validate(stated)
    except ValidationError:
        return None


def notes_on_rate(container: str) -> list[str]:
    """Return a note if the film is a zip or folder of pictures, which state no frame rate."""
    if container not in ("zip", "folder"):
        return []
    return ["Pictures state no frame rate: unless the option fps is given, 30 frames per second are assumed."]


@dataclass(frozen=True, slots=True)
class ReadFilm:
    """A film that was checked, and how its job would treat it."""

    facts: FilmFacts

    options: Options
    """With the film's picture size and frame rate."""

    interpretation: Interpretation
    """Of the film before it is tracked; `estimate` only after `with_estimate`."""


def read_film(
    source: FilmSource,
    options: Options,
    bounds: FilmBounds = FilmBounds(),  # noqa: B008 - frozen
    *,
    picture: bool = False,
) -> ReadFilm:
    """Open a film and its region, and check all options of its job, without tracking it; takes seconds, regardless of the film's length.

    `picture` adds the first frame.

    Raises
    ------
    InvalidInput
        Not a film, a limit is exceeded, or an option does not fit the film, its region or another option.
    """
    _check_region(source, options)
    with TemporaryDirectory(prefix="pliant-film-") as scratch:
        ended = _run("check", source, options, bounds, Path(scratch), picture=picture)
    facts = _answer(FilmFacts, ended, bounds, bounds.check_seconds)
    options = film_options(options, facts)
    solver_settings(options)
    return ReadFilm(facts, options, described(facts, options, has_region=source.has_region(options)))


def with_estimate(
    read: ReadFilm,
    source: FilmSource,
    bounds: FilmBounds = FilmBounds(),  # noqa: B008 - frozen
    *,
    threads: int,
) -> ReadFilm:
    """Return a checked film with the expected number of points, and the time and memory of its job on `threads` threads.

    Decodes the film up to the frame of the region.

    Raises
    ------
    InvalidInput
        The film cannot be decoded so far, or not within the limits of a check.
    """
    with TemporaryDirectory(prefix="pliant-film-") as scratch:
        ended = _run("estimate", source, read.options, bounds, Path(scratch), threads=threads)
    effort = _answer(Effort, ended, bounds, bounds.check_seconds)
    facts, interpretation = read.facts.model_copy(update=effort.model_dump()), read.interpretation
    if facts.frames and facts.points:
        points = min(facts.points, read.options.max_points or facts.points)
        expected = estimated(facts.frames, points, read.options)
        expected = expected.model_copy(update={"tracking_seconds": round(facts.track_seconds, 1)})
        interpretation = interpretation.model_copy(update={"estimate": expected})
    if facts.points == 0:
        note = f"Frame {read.options.region_frame} shows no texture that can be tracked. If the whole film is like it, the job fails."
        interpretation = interpretation.model_copy(update={"notes": [*interpretation.notes, note]})
    return ReadFilm(facts, read.options, interpretation)


def described(facts: FilmFacts, options: Options, *, has_region: bool = False) -> Interpretation:
    """Return the interpretation of a film before it is tracked."""
    of_all = f" of {facts.stated_frames}" if facts.frames and facts.frames != facts.stated_frames else ""
    count = f"{facts.frames}{of_all} frames" if facts.frames else "frames not counted yet"
    return Interpretation(
        num_frames=facts.frames, num_points=0, num_faces=0, hidden_fraction=0.0, mesh_source="film",
        has_ground_truth=False, has_rotations=False, has_region=has_region, layout="tracks (F, P, 2)", format=f"film ({facts.container})",
        given_frames=facts.stated_frames or None, image_size=f"{facts.width}x{facts.height}", fps=facts.fps,
        notes=[f"A film of {facts.width}×{facts.height} pixels, {count}, {options.fps:.3g} frames per second. "
               "Its points are not tracked yet.", *notes_on_rate(facts.container),
               *notes_on_options(options, film=True)],
    )  # fmt: skip


def film_options(options: Options, facts: FilmFacts) -> Options:
    """Return the options with the film's image size, and with its frame rate unless the job sets one.

    Until the film is tracked this is the rate that its file states; see `FilmSource.own_rate`.

    Raises
    ------
    InvalidInput
        The options give another image size, or require points to be visible in more frames than there are.
    """
    size = f"{facts.width}x{facts.height}"
    if options.image_size not in (None, size):
        raise InvalidInput(
            "invalid_option", field="options.image_size", expected=f"{size}, the size of the film, or none", got=str(options.image_size),
            hint="Leave it out: the film states its size.",
        )  # fmt: skip
    if 0 < facts.frames < options.min_seen:
        raise InvalidInput(
            "nothing_visible", field="options.min_seen", expected=f"at most {facts.frames}, the number of frames",
            got=str(options.min_seen), hint="Set min_seen lower.",
        )  # fmt: skip
    known: dict[str, Any] = {"image_size": size}
    if "fps" not in options.model_fields_set:
        known["fps"] = facts.fps
    return options.model_copy(update=known)


def _check_region(source: FilmSource, options: Options) -> None:
    if source.region is not None and options.region_polygon is not None:
        raise InvalidInput(
            "conflicting_parts", field="options.region_polygon", expected="a mask picture or a polygon", got="both",
            hint="Omit one of them.",
        )  # fmt: skip


def _run(
    action: str, source: FilmSource, options: Options, bounds: FilmBounds, scratch: Path, *, threads: int = 1, picture: bool = False,
    on_line: Callable[[dict[str, Any]], None] | None = None, should_stop: Callable[[], bool] | None = None,
) -> Ended:  # fmt: skip
    request = {
        "action": action, "film": str(source.film.absolute()), "threads": max(1, min(threads, 64)),
        "picture": picture, "region": None if source.region is None else str(source.region.absolute()),
        "names": source.names, "options": options.model_dump(mode="json", include=TRACKING_OPTIONS),
        "bounds": asdict(bounds), "folder": str(scratch.absolute()),
    }  # fmt: skip
    return run_contained(
        MODULE,
        request,
        seconds=bounds.track_seconds if action == "track" else bounds.check_seconds,
        directory=str(scratch),
        environment={"TMPDIR": str(scratch.absolute()), "MALLOC_ARENA_MAX": "2"},
        on_line=on_line,
        should_stop=should_stop,
    )


Answer = TypeVar("Answer", FilmFacts, Effort, Tracked)


def _answer(kind: type[Answer], ended: Ended, bounds: FilmBounds, seconds: float) -> Answer:
    if ended.code == DONE:
        try:
            return kind.model_validate_json(ended.answer)
        except ValidationError:
            raise damaged("film", INCONSISTENT) from None
    raise _fault(ended, bounds, seconds)


def _fault(ended: Ended, bounds: FilmBounds, seconds: float) -> Exception:
    if ended.code == REFUSED:
        return refusal_in(ended.answer) or damaged("film", INCONSISTENT)
    if ended.overdue or ended.code == -signal.SIGXCPU:
        return InvalidInput(
            "too_slow", field="film", expected=f"a film that is decoded and tracked within {seconds:g} s", got="one that takes longer",
            hint="Select fewer frames, lower longest_side, or convert the film: ffmpeg -i FILM -vf scale=1280:-2 film.mp4",
        )  # fmt: skip
    if ended.code == -signal.SIGKILL:
        return too_large("film", expected=f"a film that is tracked within {bounds.memory >> 20} MiB", got="more")
    if ended.code < 0:
        return damaged("film", f"a film that stops its decoder (signal {-ended.code})")
    return RuntimeError(f"the film process ended with {ended.code}: {ended.errors}")

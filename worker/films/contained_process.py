"""The film process, the only one that decodes films. It has resource limits, no network, and its own scratch folder."""

from __future__ import annotations

import base64
import errno
import json
import os
import re
import resource
import sys
import time
from collections.abc import Callable
from contextlib import closing
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pliant.schemas.film_limits import FilmLimits
from pliant.solver.errors import InvalidInput
from pliant.worker.films import frame_strip
from pliant.worker.films.bounds import FilmBounds
from pliant.worker.films.frame_strip import write_frames
from pliant.worker.formats.errors import too_large
from pliant.worker.processes.contained import limit_process, serve
from pliant.worker.processes.no_network import restrict_process

if TYPE_CHECKING:
    from pliant.tracking import Film, FilmError, TrackingStep

OPEN_FILES = 256
"""Maximum number of open descriptors: libraries, the film, the frame store."""

PROGRESS_EVERY = 0.2
"""Minimum seconds between two lines of progress."""

FOLLOWED_POINTS = 150
"""Maximum number of points shown while tracking runs: about 1.5 kB in a record that is rewritten twice a second."""

SHARES = {"read": (0.0, 0.15), "locate": (0.15, 0.25), "track": (0.25, 0.65), "fit": (0.65, 0.8), "refine": (0.8, 1.0)}
"""Start and end of each stage of the tracker, as fractions of the tracking time, from typical timings."""

LOOKED = 1 / 3
"""Share of the check's time after which two frames that differ are no longer looked for: a film may begin with a still picture."""

PICTURE_SIDE, PICTURE_QUALITY = 800, 80
"""Longest side in pixels and JPEG quality of the first frame in the answer: about 0.1 MB, at most 0.5 MB."""

FULL = ("Insufficient memory", "can't start new thread")
"""Messages of OpenCV and Python when the address space is exhausted."""

PLANNED = ("template_frame", "grid_step", "longest_side", "region_frame")
"""Job options that are parameters of the tracker."""

OPTIONS = ("frames", *PLANNED)
"""Fields of a `FilmError` that are job options."""


def main() -> int:
    """Check, estimate or track the film of the request on standard input; answer on standard output."""
    return serve(_answer)


def _answer(request: dict[str, Any]) -> str:
    restrict_process()
    try:
        import pliant.tracking as tracking
    except ImportError as error:
        raise InvalidInput(
            "film_unavailable", field="film", expected="tracks, or a service with OpenCV", got="a film",
            hint="Install the extra film beside service and worker (pip install '.[film]' in Pliant's source folder), or send tracks.",
        ) from error  # fmt: skip
    if request["action"] != "check":
        import_module("pliant.tracking.track")  # before the memory limit, which is meant for the film
    bounds = FilmBounds(**request["bounds"] | {"limits": FilmLimits(**request["bounds"]["limits"])})
    seconds = bounds.track_seconds * request["threads"] if request["action"] == "track" else bounds.check_seconds
    limit_process(
        {
            resource.RLIMIT_AS: bounds.memory,
            resource.RLIMIT_CPU: max(1, round(seconds)),
            resource.RLIMIT_FSIZE: bounds.scratch_bytes,
            resource.RLIMIT_CORE: 0,
            resource.RLIMIT_NOFILE: OPEN_FILES,
        }
    )
    try:
        return json.dumps(_ACTIONS[request["action"]](request, bounds))
    except tracking.FilmError as error:
        raise _refused(error, request) from error
    except Exception as error:
        if _for_want_of_memory(error):
            raise _too_costly(bounds) from error
        raise


def _check(request: dict[str, Any], bounds: FilmBounds) -> dict[str, Any]:
    """Open the film, decode it up to two frames that differ, read the region, and check the options against both."""
    from pliant.tracking import FilmError
    from pliant.tracking.decoding.film import LEAST_FRAMES
    from pliant.tracking.planning.options import check_against
    from pliant.tracking.region import read_region

    film, planned = _opened(request, bounds), _planned(request)
    start, stop, step = film.selection
    count = len(range(film.stated_frames)[start:stop:step]) if film.stated_frames else None
    if count is not None and count > bounds.limits.frames:
        raise FilmError(
            "too_many_frames", field="film", expected=f"at most {bounds.limits.frames} frames", got=str(count),
            hint="Select some with frames, for example 0:3000:2.",
        )  # fmt: skip
    with closing(film.frames()) as frames:
        first = next(frames, None)
        if first is None:  # the file states more frames than it has
            raise film.too_few_frames(0)
        if count is not None and count < LEAST_FRAMES:
            raise film.too_few_frames(count)
        for frame in frames:  # raises an error if all are equal, as those of an interlaced film are
            if not np.array_equal(frame.image, first.image) or time.process_time() > LOOKED * bounds.check_seconds:
                break
    region = _region(request)
    if region is not None:
        read_region(region, film.size)
    check_against(film, region=region, **planned)
    facts: dict[str, Any] = {
        "container": film.container, "width": film.size[0], "height": film.size[1], "fps": film.fps / step,
        "stated_frames": film.stated_frames, "frames": count or 0, "seconds": film.stated_frames / film.fps,
        "rotation": film.rotation, "pixel_aspect": film.pixel_aspect,
    }  # fmt: skip
    if request["picture"]:
        facts["first_frame"] = _first_frame(request, bounds)
    return facts


def _estimate(request: dict[str, Any], bounds: FilmBounds) -> dict[str, Any]:
    """Estimate the number of points and the time of tracking; decodes the film up to the frame of the region."""
    from pliant.tracking.estimate import estimate

    expected = estimate(
        _opened(request, bounds), region=_region(request), threads=request["threads"], **_planned(request)
    )
    return {"points": expected.points, "track_seconds": expected.seconds}


def _first_frame(request: dict[str, Any], bounds: FilmBounds) -> str:
    """Return the first frame of the complete film as a JPEG in base64."""
    from pliant.tracking import open_film
    from pliant.tracking.contact_sheet import small_jpeg

    first = next(open_film(Path(request["film"]), limits=bounds.limits).frames())
    return base64.b64encode(small_jpeg(first.image, longest_side=PICTURE_SIDE, quality=PICTURE_QUALITY)).decode()


def _track(request: dict[str, Any], bounds: FilmBounds) -> dict[str, Any]:
    """Track the film; write `tracks.npz`, `contact_sheet.jpg` and `film_frames.bin` into the scratch folder."""
    from pliant.tracking import track_film

    folder = Path(request["folder"])
    film = _opened(request, bounds)
    tracked = track_film(
        film,
        region=_region(request),
        threads=request["threads"],
        on_step=_reporter(request["progress"], film.size),
        on_warnings=lambda warnings: _write_line(request["progress"], {"warnings": warnings}),
        **_planned(request),
    )
    tracked.save_npz(folder / "tracks.npz")
    (folder / "contact_sheet.jpg").write_bytes(tracked.contact_sheet())
    write_frames(film, tracked.film.frame_indices, folder / frame_strip.NAME)
    return {"container": tracked.film.container, "fps": tracked.fps, "warnings": list(tracked.warnings)}


_ACTIONS: dict[str, Callable[[dict[str, Any], FilmBounds], dict[str, Any]]] = {
    "check": _check,
    "estimate": _estimate,
    "track": _track,
}


def _opened(request: dict[str, Any], bounds: FilmBounds) -> Film:
    from pliant.tracking import open_film

    return open_film(Path(request["film"]), frames=request["options"]["frames"], limits=bounds.limits)


def _planned(request: dict[str, Any]) -> dict[str, Any]:
    return {name: request["options"][name] for name in PLANNED}


def _region(request: dict[str, Any]) -> Path | list[list[float]] | None:
    polygon: list[list[float]] | None = request["options"]["region_polygon"]
    return polygon if request["region"] is None else Path(request["region"])


def _reporter(target: int, size: tuple[int, int]) -> Callable[[TrackingStep], None]:
    """Return a callback that writes progress and tracked points to a descriptor, at most every `PROGRESS_EVERY` seconds."""
    after = 0.0

    def report(step: TrackingStep) -> None:
        nonlocal after
        now = time.monotonic()
        if now < after:
            return
        after = now + PROGRESS_EVERY
        low, high = SHARES[step.stage]
        done = low if not step.total else low + (high - low) * min(1.0, step.done / step.total)
        line = {"done": done, "observations": _observations(step), "followed": _followed(step, size)}
        _write_line(target, line)

    return report


def _write_line(target: int, line: dict[str, Any]) -> None:
    """Write a line to a descriptor."""
    os.write(target, json.dumps(line).encode() + b"\n")


def _observations(step: TrackingStep) -> list[int] | None:
    """Return the expected numbers of frames and points, None while unknown; a few points may be dropped at the end."""
    if step.followed is None or step.total is None:
        return None
    return [step.total, len(step.followed.points)]


def _followed(step: TrackingStep, size: tuple[int, int]) -> dict[str, Any] | None:
    """Return up to `FOLLOWED_POINTS` visible points of the frame just tracked, in the schema `FollowedPoints`."""
    if step.followed is None:
        return None
    # In a random order, the same in every frame: every n-th point of a grid would be whole columns of it.
    order = np.random.default_rng(0).permutation(len(step.followed.points))
    some = step.followed.points[order[step.followed.visible[order]][:FOLLOWED_POINTS]]
    return {
        "frame": step.followed.index, "seconds": step.followed.time, "width": size[0], "height": size[1],
        "points": some.round().astype(int).ravel().tolist(),
    }  # fmt: skip


def _refused(error: FilmError, request: dict[str, Any]) -> InvalidInput:
    """Return the error with the job's field names, and with the user's file names instead of paths."""
    field = f"options.{error.field}" if error.field in OPTIONS else error.field
    if field == "region" and request["region"] is None and request["options"]["region_polygon"] is not None:
        field = "options.region_polygon"
    got = error.got
    for name in ("film", "region"):
        if request[name] is not None:
            got = _renamed(got, Path(request[name]), str(request["names"][name]))
    return InvalidInput(error.code, field=field, expected=error.expected, got=got, hint=error.hint)


def _renamed(got: str, path: Path, name: str) -> str:
    """Replace a file's path or name by the user's name for it, at the start of the text or after "in"."""
    start, own, rest = got.replace(f"{path.parent}{os.sep}", "").partition(path.name)
    named = own != "" and (start == "" or start.endswith(" in ")) and re.match(r"\w", rest) is None
    return f"{start}{name}{rest}" if named else f"{start}{own}{rest}"


def _for_want_of_memory(error: Exception) -> bool:
    """Return whether the error is due to the limit on memory or file size."""
    full = isinstance(error, OSError) and error.errno in (errno.ENOMEM, errno.EFBIG)
    return isinstance(error, MemoryError) or full or any(sign in str(error) for sign in FULL)


def _too_costly(bounds: FilmBounds) -> InvalidInput:
    return too_large("film", expected=f"a film that needs at most {bounds.memory >> 20} MiB", got="one that needs more")


if __name__ == "__main__":
    sys.exit(main())

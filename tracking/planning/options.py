"""Check the tracker's options, before a film is decoded."""

from __future__ import annotations

import math
import operator
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pliant.schemas.pictures import is_frame
from pliant.tracking.decoding.film import Film
from pliant.tracking.errors import FilmError
from pliant.tracking.survey import BROKEN_SHARE, tracking_scale

if TYPE_CHECKING:
    from pliant.tracking.region import Region


def check_numbers(
    *, grid_step: float | None, longest_side: int, threads: int | None, region_frame: int, template_frame: int | None
) -> None:
    """Check what can be checked without a film.

    Raises
    ------
    FilmError
        An option is no number, or out of its range.
    """
    checks: tuple[tuple[str, str, Any, type[Any], int, int], ...] = (
        ("grid_step", "a distance of 1 to 100 pixels", grid_step, Real, 1, 100),
        ("longest_side", "64 to 4096 pixels", longest_side, Real, 64, 4096),
        ("threads", "1 to 64 threads", threads, Integral, 1, 64),
    )
    for field, expected, got, kind, least, most in checks:
        if got is not None and not (isinstance(got, kind) and least <= got <= most):
            raise FilmError("out_of_range", field=field, expected=expected, got=str(got), hint="Correct the argument.")
    frames: tuple[tuple[str, Any], ...] = (("region_frame", region_frame), ("template_frame", template_frame))
    for field, frame in frames:
        if frame is not None and not (isinstance(frame, Integral) and operator.index(frame) >= 0):
            raise no_such_frame(field, frame, 0, None)


def check_against(
    film: Film,
    *,
    region: Region | None,
    region_frame: int,
    template_frame: int | None,
    grid_step: float | None,
    longest_side: int,
) -> None:
    """Check options against the frames that a film states and its size, and that the region's picture is none of the frames.

    Raises
    ------
    FilmError
        A frame beyond the film's end, a template that is not among the selected frames, a region's frame too far from them, or points
        closer together than the pixels of the tracker's frames; or a mask picture in the film's folder.
    """
    start, stop, step = film.selection
    end = film.stated_frames - 1 if film.stated_frames else None
    _check_frame("region_frame", region_frame, end)
    if template_frame is not None:
        _check_frame("template_frame", template_frame, end)
        after = None if stop is None else start + -(-(stop - start) // step) * step
        before = max(0, start - step + 1)
        if template_frame < before or (after is not None and template_frame >= after):
            raise no_such_frame("template_frame", template_frame, before, end if after is None else after - 1)
    if region is not None:
        film.reaching(region_frame)
        if isinstance(region, str | Path) and is_frame(Path(region), film.path):
            raise FilmError(
                "wrong_region", field="region", expected="a mask outside the film's folder of pictures",
                got=f"{Path(region).name} in it, which would be a frame of the film", hint="Move the mask to another folder.",
            )  # fmt: skip
    scale = tracking_scale(film.size, longest_side)
    if grid_step is not None and grid_step * scale < 1:
        raise FilmError(
            "out_of_range", field="grid_step", expected=f"at least {math.ceil(100 / scale) / 100:g} pixels, one of the tracker's frames",
            got=f"{grid_step:g}", hint="Use a larger step, or a larger longest_side.",
        )  # fmt: skip


def _check_frame(field: str, frame: int, last: int | None) -> None:
    """Check a frame number against the last one that a film states; containers are off by a few frames."""
    if last is not None and frame * BROKEN_SHARE > last:
        raise no_such_frame(field, frame, 0, last)


def no_such_frame(field: str, frame: object, first: int, last: int | None) -> FilmError:
    """Return (not raise) the error for a frame that is not from `first` to `last`; None: the last one is unknown."""
    number = "frame number" if isinstance(frame, Integral) else "whole frame number"
    return FilmError(
        "no_such_frame", field=field, expected=f"a {number} from {first}" + ("" if last is None else f" to {last}"), got=str(frame),
        hint="Frames are counted in the whole film from 0.",
    )  # fmt: skip

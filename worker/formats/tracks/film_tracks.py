"""The output of `pliant track`: tracks with confidence, mesh, picture size, frame rate and texture, all of which are used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import InvalidInput, Mesh
from pliant.worker.formats.errors import damaged
from pliant.worker.formats.reading.containers import read_arrays
from pliant.worker.formats.records import Arrays, Limits
from pliant.worker.formats.texture import Texture
from pliant.worker.formats.tracker_warnings import ARRAY as WARNINGS
from pliant.worker.formats.tracker_warnings import read_warnings
from pliant.worker.formats.tracks.frame_times import ARRAY as TIMES
from pliant.worker.formats.tracks.frame_times import mean_rate, read_frame_times

REQUIRED = ("visibility", "confidence", "grid", "image_size", "fps")
TEXTURE_ARRAYS = ("template_image", "uv")
MAX_RATE = 1000.0
"""Largest frame rate of the option `fps`."""

MAX_PICTURE_SIDE = 10**5
"""Largest width or height of a picture, pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class FilmTracks:
    """Contents of a file of `pliant track` besides its tracks."""

    visible: NDArray[np.float64]
    """The tracker's confidence where a point is visible, else 0, shape `(F, P)`."""

    mesh: Mesh
    image_size: tuple[int, int]
    """Width and height of the film in pixels."""

    fps: float
    """Frames per second, if the times are unknown."""

    times: NDArray[np.float64] | None
    """Seconds of every frame, shape `(F,)`; None if they were removed from the file."""

    texture: Texture | None
    """The template frame with texture coordinates; None if they were removed from the file."""

    warnings: tuple[str, ...]
    """The tracker's warnings about the film."""

    def rate(self, frames: NDArray[np.intp]) -> float:
        """Return the frames per second of some of the frames, by their increasing indices."""
        if self.times is None:
            return self.fps / float(np.median(np.diff(frames)))
        return min(mean_rate(self.times[frames]), MAX_RATE)


def read_film_tracks(path: Path, *, field: str, shape: tuple[int, int], limits: Limits) -> FilmTracks:
    """Read the contents of a file of `pliant track` besides its tracks; `field` is the input that holds it, `shape` frames and points.

    Raises
    ------
    InvalidInput
        Code damaged_file if an array is missing or does not fit the tracks, and the codes of `read_arrays` and `Mesh`.
    """
    arrays = read_arrays(
        path, field=field, limits=limits, wanted=frozenset((*REQUIRED, TIMES, WARNINGS, *TEXTURE_ARRAYS))
    )
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise InvalidInput(
            "damaged_file", field=field, expected="all arrays that pliant track writes, because there is one named frame_indices",
            got=f"a file without {', '.join(missing)}", hint="Write the file again, or rename frame_indices if another program wrote it.",
        )  # fmt: skip
    for name in ("visibility", "confidence"):
        if arrays[name].shape != shape or arrays[name].dtype.kind not in "bfiu":
            raise damaged(field, f"{name} of shape {arrays[name].shape} beside tracks of shape {(*shape, 2)}")
    confidence = np.asarray(arrays["confidence"], dtype=np.float64)
    if not ((confidence >= 0) & (confidence <= 1)).all():
        raise damaged(field, "confidence outside 0 … 1")
    mesh = Mesh.from_grid(arrays["grid"])
    if mesh.num_points != shape[1]:
        raise damaged(field, f"a grid of {mesh.num_points} points beside tracks of {shape[1]}")
    size, fps = _shot(arrays, field)
    texture = None
    if all(name in arrays for name in TEXTURE_ARRAYS):
        texture = _texture(arrays, shape[1], field)
    visible = np.where(arrays["visibility"].astype(bool), confidence, 0.0)
    times, warnings = read_frame_times(arrays, shape[0], field=field), read_warnings(arrays, field=field)
    return FilmTracks(visible, mesh, size, fps, times, texture, warnings)


def tracks_options(options: Options, interpretation: Interpretation) -> Options:
    """Return the options with the image size and frame rate of a tracks file, unless the options set them."""
    stated: dict[str, Any] = {}
    if options.image_size is None and interpretation.image_size is not None:
        stated["image_size"] = interpretation.image_size
    if "fps" not in options.model_fields_set and interpretation.fps is not None:
        stated["fps"] = interpretation.fps
    return options.model_copy(update=stated) if stated else options


def _shot(arrays: Arrays, field: str) -> tuple[tuple[int, int], float]:
    size, rate = arrays["image_size"], arrays["fps"]
    if size.shape != (2,) or size.dtype.kind not in "iu" or not ((size > 0) & (size <= MAX_PICTURE_SIDE)).all():  # type: ignore[operator]
        raise damaged(field, "an image_size that is not two positive integers, width and height")
    fps = float(rate) if rate.shape == () and rate.dtype.kind in "fiu" else np.nan
    if not 0 < fps <= MAX_RATE:
        raise damaged(field, f"an fps that is not a number from 0 to {MAX_RATE:g}")
    return (int(size[0]), int(size[1])), fps


def _texture(arrays: Arrays, num_points: int, field: str) -> Texture:
    places = arrays["uv"]
    if places.shape != (num_points, 2) or places.dtype.kind != "f" or not np.isfinite(places).all():
        raise damaged(field, f"texture coordinates of shape {places.shape} for {num_points} points")
    try:
        return Texture.from_tracked(arrays["template_image"], np.clip(places, 0, 1))
    except InvalidInput as error:
        raise damaged(field, f"a template_image that is no picture ({error.got})") from error

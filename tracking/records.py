"""Progress reports and results of the tracker."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pliant.solver.storage import let_go
from pliant.tracking.contact_sheet import View, draw_contact_sheet

Stage = Literal["read", "locate", "track", "fit", "refine"]


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """Points in one frame, for display while tracking runs."""

    index: int
    """Number of the frame in the whole film, from 0."""

    time: float
    """Seconds from the film's start."""

    points: NDArray[np.float32]
    """Positions in the film's pixels, shape `(P, 2)`."""

    visible: NDArray[np.bool_]
    """Shape `(P,)`."""


@dataclass(frozen=True, slots=True)
class TrackingStep:
    """Progress of one stage."""

    stage: Stage
    """"read": decode the film; "locate": find the region in the template; "track": follow the points; "fit": fit their paths to all frames;
    "refine": follow them again from there."""

    done: int
    """Completed frames of this stage; steps in "fit"."""

    total: int | None
    """Frames of this stage, steps in "fit"; None while the film's length is unknown."""

    followed: Followed | None = field(default=None, compare=False)
    """Points in the frame just completed; only in "track" and "refine"."""


OnStep = Callable[[TrackingStep], None]


@dataclass(frozen=True, slots=True, eq=False)
class FilmInfo:
    """Properties of a film."""

    name: str
    container: str
    size: tuple[int, int]
    """Width and height in pixels, upright: rotation flags are applied."""

    fps: float
    """Frames per second, from the times of the frames used."""

    frame_indices: NDArray[np.int64]
    """Numbers of the frames used, counted in the whole film from 0, shape `(F,)`."""

    frame_times: NDArray[np.float64]
    """Seconds from the film's start, shape `(F,)`; not evenly spaced for films of variable frame rate."""

    cuts: tuple[int, ...]
    """Frame numbers at which a new shot begins."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFilm:
    """Dense tracks of a film, in the film's own pixels: x right, y down, the first pixel's centre at (0, 0).

    Tracks, visibility and confidence lie in temporary files, which are deleted with the arrays.
    """

    film: FilmInfo
    tracks: NDArray[np.float32]
    """Shape `(F, P, 2)`; the best guess where a point is hidden."""

    visibility: NDArray[np.bool_]
    """Shape `(F, P)`."""

    confidence: NDArray[np.float32]
    """The film's median variance over that of the observation, at most 1; 0 where hidden, shape `(F, P)`."""

    grid: NDArray[np.int32]
    """Point of every grid cell, −1 for holes, shape `(rows, columns)`."""

    faces: NDArray[np.int32]
    """Quads of the grid, shape `(T, 4)`, counter-clockwise as the template shows them."""

    template: int
    """Index of the template among the F frames."""

    template_image: NDArray[np.uint8]
    """The template in colour, shape `(H, W, 3)`, RGB."""

    uv: NDArray[np.float32]
    """Texture coordinates in the template image, shape `(P, 2)`, in [0, 1]: u right, v down, (0, 0) its upper left corner."""

    thumbnails: NDArray[np.uint8]
    """Some frames in colour, shape `(N, h, w, 3)`: the part that all visible points occupy, enlarged or reduced to w = 320 pixels, and
    stretched or squeezed to h from 80 to 960."""

    thumbnail_view: View
    """That part: first column and row, width and height in pixels of the film."""

    thumbnail_frames: NDArray[np.int64]
    """Indices of the thumbnails among the F frames, shape `(N,)`."""

    warnings: tuple[str, ...]
    """Sentences about what may spoil a reconstruction."""

    @property
    def frame_times(self) -> NDArray[np.float64]:
        """Seconds from the film's start, shape `(F,)`."""
        return self.film.frame_times

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.film.fps

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the film in pixels."""
        return self.film.size

    def save_npz(self, path: Path | str) -> None:
        """Write tracks, mesh, times and warnings as a compressed NumPy archive.

        Keys: `tracks`, `visibility`, `confidence`, `faces`, `grid`, `uv`, `template`, `template_image`, `frame_indices`,
        `frame_times`, `fps`, `image_size` (width, height), `warnings`.
        """
        arrays = {
            "tracks": self.tracks, "visibility": self.visibility, "confidence": self.confidence, "faces": self.faces,
            "grid": self.grid, "uv": self.uv, "template": self.template, "template_image": self.template_image,
            "frame_indices": self.film.frame_indices, "frame_times": self.film.frame_times, "fps": self.film.fps,
            "image_size": self.film.size, "warnings": np.array(self.warnings, dtype=np.str_),
        }  # fmt: skip
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, value in arrays.items():
                array = np.asarray(value)
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    _write_array(member, array)

    def contact_sheet(self, *, png: bool = False) -> bytes:
        """Draw the tracks over some frames, as one small JPEG or PNG picture."""
        return draw_contact_sheet(self, png=png)


def _write_array(file: IO[bytes], array: NDArray[Any]) -> None:
    """Write an array in NumPy's format, stored ones without their whole size in memory."""
    np.lib.format.write_array_header_1_0(
        file, {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape}
    )
    for part in array if array.ndim > 1 else array[None]:
        file.write(part.tobytes())
        let_go(array)

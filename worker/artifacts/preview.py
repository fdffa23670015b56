"""A compact copy of a result for the web page: `preview.bin`.

The page plays a result of 99 frames and 29,000 points in a browser, also on a phone. `shapes.glb` with one morph target per
frame is twice as large and keeps all targets in graphics memory, where the shader evaluates them for every vertex;
`shapes.npz` is four times as large and cannot be streamed. This file stores int16 coordinates frame by frame, so that
drawing starts with the first frame, and optional data (residuals, ground truth) at offsets for range requests.

Layout, little-endian: `b"PLIANTPV"`, uint32 version, uint32 length of the header, the header as JSON in UTF-8, then sections at
the offsets given in the header, each a multiple of 8.

=========  ==================  ===================================================================================
section    type and shape      meaning
=========  ==================  ===================================================================================
faces      uint32 (T, 3)       triangles; quads are split
cameras    float32 (F, 10)     rotation row by row, camera from world; then the scale
positions  int16 (F, P, 3)     world = origin + step · value
residuals  int16 (F, P, 2)     track − projection = residual_step · value; both −32768 where hidden
truth      int16 (F, P, 3)     as positions, aligned with the result as for `e3d_frame_scaled`; only with ground truth
frames     float32 (F, 6)      translation x, y; hidden share; expected error and `e3d_frame_scaled` as shares of the
                               object's size; median residual. NaN where unknown
points     uint32 (P, 2)       number of frames, of all, that show each point, and number in which it was rejected
spread     uint16 (F, P)       standard deviation of a position = spread_step · value. Only with a posterior
rejected   uint8 (F, ⌈P/8⌉)    bits, the lowest first: seen observations that the solver rejected as outliers
times      float32 (F,)        seconds of every frame from the first. Only for films of uneven frame rate
names      UTF-8, P lines      names of the points. Only where the tracks' file has them
places     float32 (P, 2)      position of every point in the picture, 0 to 1: u right, v down. Only for films
picture    JPEG                the film's template frame. Only for films
=========  ==================  ===================================================================================

Readers skip sections that they do not know; all after `residuals` may be missing.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import IO

import numpy as np
from numpy.typing import NDArray
from pliant.solver import Solution, Tracks
from pliant.solver.evaluation.alignment import align
from pliant.solver.evaluation.trust import size_of
from pliant.solver.mesh import triangles_of
from pliant.worker.artifacts.geometry import Floats
from pliant.worker.artifacts.result import Result
from pliant.worker.formats import Inputs

NAME = "preview.bin"
MEDIA_TYPE = "application/octet-stream"
DESCRIPTION = "Compact int16 copy that the web page plays; not for measuring."

MAGIC = b"PLIANTPV"
VERSION = 1
LARGEST = 32767
LARGEST_COUNT = 65535
HIDDEN = -32768
LEAST_TRUE = 3
"""Minimum number of points with truth for an alignment."""
MOST_OBSERVATIONS = 16_000_000
"""Number of points × frames (96 MB of positions) above which only every n-th frame is written."""


@dataclass(frozen=True, slots=True)
class Box:
    """The uniform grid to which coordinates are rounded: `world = origin + step · value`."""

    origin: Floats
    step: float

    @classmethod
    def around(cls, *clouds: Floats) -> Box:
        """Return the smallest grid that contains all points of the clouds, each `(F, P, 3)`."""
        low = np.min([cloud.min(axis=(0, 1)) for cloud in clouds], axis=0)
        high = np.max([cloud.max(axis=(0, 1)) for cloud in clouds], axis=0)
        return cls((low + high) / 2, float((high - low).max() / 2 / LARGEST) or 1.0)

    def rounded(self, frame: Floats) -> NDArray[np.int16]:
        """Round one frame's points `(P, 3)`, with an error of at most half a step."""
        return np.rint((frame - self.origin) / self.step).clip(-LARGEST, LARGEST).astype("<i2")


@dataclass(frozen=True, slots=True)
class Rounding:
    """Steps of the integers in the file, in the tracks' unit."""

    box: Box
    residual_step: float
    spread_step: float
    """0 without a posterior."""

    @classmethod
    def of(cls, tracks: Tracks, solution: Solution, facing: Floats | None) -> Rounding:
        """Return the finest steps that cover every value; `facing` is the truth aligned with the result."""
        std = solution.shapes_std
        return cls(
            Box.around(solution.shapes) if facing is None else Box.around(solution.shapes, facing),
            residual_step=_largest_residual(tracks, solution) / LARGEST or 1.0,
            spread_step=0.0 if std is None else float(std.max()) / LARGEST_COUNT or 1.0,
        )

    def header(self) -> dict[str, object]:
        """Return the header entries that restore the values."""
        return {
            "origin": self.box.origin.tolist(),
            "step": self.box.step,
            "residual_step": self.residual_step,
            "spread_step": self.spread_step,
        }


@dataclass(frozen=True, slots=True)
class Section:
    """One section of the file; its parts are generated while they are written."""

    name: str
    size: int
    """Bytes, before padding."""
    parts: Iterable[bytes]

    @classmethod
    def of(cls, name: str, array: NDArray[np.generic]) -> Section:
        """Return a whole array as a section."""
        return cls(name, array.nbytes, [array.tobytes()])


def write_preview(result: Result, file: IO[bytes]) -> None:
    """Write the file. A truth may have any axes, and NaN where it is unknown."""
    inputs, solution, options = result.inputs, result.solution, result.options
    truth = None if inputs.ground_truth is None else inputs.ground_truth.shapes
    stride = max(1, -(-solution.shapes[..., 0].size // MOST_OBSERVATIONS))
    facing, mirrored = (None, False) if truth is None else _onto(solution.shapes, truth)
    rounding = Rounding.of(inputs.tracks, solution, facing)
    kept, faces = range(0, len(solution.shapes), stride), triangles_of(result.faces).astype("<u4")
    header = {
        "version": VERSION,
        "num_frames": len(kept),
        "num_points": solution.shapes.shape[1],
        "num_faces": len(faces),
        "fps": options.fps / stride,
        "frame_stride": stride,
        "y_axis": result.y_axis,
        "mirrored": mirrored,
        **rounding.header(),
        "size": size_of(solution.shapes),
        "all_frames": len(solution.shapes),
        "focal": solution.camera.focal,
        "principal_point": solution.camera.principal_point.tolist(),
        "image_size": None if options.picture_size is None else [float(side) for side in options.picture_size],
    }
    sections = [Section.of("faces", faces), *_sections(inputs.tracks, solution, truth, facing, kept, rounding)]
    if result.uneven_times is not None:
        sections.append(Section.of("times", result.uneven_times[kept].astype("<f4")))
    _write(file, header, [*sections, *_input_sections(inputs)])


def _input_sections(inputs: Inputs) -> list[Section]:
    """Return the sections that only some inputs have: names of the points, and the picture with the points' positions in it."""
    sections, texture = [], inputs.texture
    if inputs.point_names is not None:
        names = "\n".join(inputs.point_names).encode()
        sections.append(Section("names", len(names), [names]))
    if texture is not None:
        sections.append(Section.of("places", texture.uv.astype("<f4")))
        sections.append(Section("picture", len(texture.jpeg), [texture.jpeg]))
    return sections


def _sections(
    tracks: Tracks, solution: Solution, truth: Floats | None, facing: Floats | None, kept: range, rounding: Rounding
) -> list[Section]:
    """Return the sections from `cameras` to `rejected`, of the frames kept; `facing` is the truth aligned with the result."""
    shapes, std, camera = solution.shapes, solution.shapes_std, solution.camera
    count, points = len(kept), shapes.shape[1]
    box, step = rounding.box, rounding.residual_step
    seen = tracks.visible > 0
    rejected = seen & (solution.weights == 0)
    table = np.column_stack([camera.rotations.reshape(-1, 9), camera.scales])[kept]
    sections = [
        Section.of("cameras", table.astype("<f4")),
        Section("positions", 6 * points * count, (box.rounded(shapes[f]).tobytes() for f in kept)),
        Section("residuals", 4 * points * count, (_residuals(tracks, solution, f, step).tobytes() for f in kept)),
    ]
    if facing is not None:
        sections.append(Section("truth", 6 * points * count, (box.rounded(facing[f]).tobytes() for f in kept)))
    sections += [
        Section.of("frames", _frames_table(tracks, solution, truth)[kept].astype("<f4")),
        Section.of("points", np.column_stack([seen.sum(axis=0), rejected.sum(axis=0)]).astype("<u4")),
    ]
    if std is not None:
        rounded = (np.rint(std[f] / rounding.spread_step).astype("<u2").tobytes() for f in kept)
        sections.append(Section("spread", 2 * points * count, rounded))
    sections.append(Section.of("rejected", np.packbits(rejected[kept], axis=1, bitorder="little")))
    return sections


def _frames_table(tracks: Tracks, solution: Solution, truth: Floats | None) -> Floats:
    """Return one row for each frame, see the section `frames`; shape `(F, 6)`."""
    count = len(solution.shapes)
    table = np.full((count, 6), np.nan)
    table[:, :2] = solution.camera.translations
    table[:, 2] = 1 - (tracks.visible > 0).mean(axis=1)
    if solution.shapes_std is not None:
        table[:, 3] = np.sqrt(np.square(solution.shapes_std).mean(axis=1)) / size_of(solution.shapes)
    if truth is not None and (known := np.isfinite(truth).all(axis=(0, 2))).sum() >= LEAST_TRUE:
        table[:, 4] = align(solution.shapes[:, known], truth[:, known], kind="frame_scaled").relative
    for frame in range(count):
        lengths = np.linalg.norm(_residual(tracks, solution, frame)[tracks.visible[frame] > 0], axis=1)
        if len(lengths):
            table[frame, 5] = np.median(lengths)
    return table


def _onto(shapes: Floats, truth: Floats) -> tuple[Floats | None, bool]:
    """Return the truth aligned with the result per frame and in its size, and whether the result's depth has the opposite sign.

    None if too few points have a truth, or if the result has no extent.

    Points without truth are excluded from the alignment and take the position of the result.
    """
    known = np.isfinite(truth).all(axis=(0, 2))
    if known.sum() < LEAST_TRUE:
        return None, False
    aligned = align(shapes[:, known], truth[:, known], kind="frame_scaled")
    scale = float(aligned.scales.mean())
    if scale == 0:  # the result is one point
        return None, False
    turned = shapes.copy()
    # aligned.shapes = k (S − centre) Tᵀ ≈ G, so G T / k + centre ≈ S.
    centre = shapes[:, known].mean(axis=1, keepdims=True)
    turned[:, known] = aligned.truth @ aligned.transforms / scale + centre
    return turned, bool(np.linalg.det(aligned.transforms[0]) < 0)


def _residual(tracks: Tracks, solution: Solution, frame: int) -> Floats:
    one = slice(frame, frame + 1)
    return np.asarray(tracks.points[frame] - solution.camera.at(one).project(solution.shapes[one])[0])


def _largest_residual(tracks: Tracks, solution: Solution) -> float:
    return max(
        float(np.abs(_residual(tracks, solution, frame)[tracks.visible[frame] > 0]).max(initial=0.0))
        for frame in range(len(solution.shapes))
    )


def _residuals(tracks: Tracks, solution: Solution, frame: int, step: float) -> NDArray[np.int16]:
    scaled = np.rint(_residual(tracks, solution, frame) / step).clip(-LARGEST, LARGEST).astype("<i2")
    scaled[tracks.visible[frame] == 0] = HIDDEN
    return scaled


def _write(file: IO[bytes], header: dict[str, object], sections: Sequence[Section]) -> None:
    """Write magic, version, header and sections; the header has a fixed length because its offsets depend on its length."""
    length = 2048
    offset, places = 16 + length, {}
    for section in sections:
        places[section.name] = {"offset": offset, "bytes": section.size}
        offset += _padded(section.size)
    text = json.dumps({**header, "sections": places}, allow_nan=False).encode().ljust(length)
    if len(text) > length:
        raise AssertionError(f"the preview's header takes {len(text)} bytes, more than {length}")
    file.write(MAGIC + struct.pack("<II", VERSION, length) + text)
    for section in sections:
        for part in section.parts:
            file.write(part)
        file.write(bytes(_padded(section.size) - section.size))


def _padded(size: int) -> int:
    return -(-size // 8) * 8

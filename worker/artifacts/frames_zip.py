"""One mesh file a frame in a zip, as programs for captured motion read them."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterable
from typing import IO

import numpy as np
from pliant.worker.artifacts.geometry import Floats, Ints

FIRST_DAY = (1980, 1, 1, 0, 0, 0)


def write_ply_zip(
    file: IO[bytes], shapes: Floats, faces: Ints, *, y_axis: str, on_progress: Callable[[float], None] | None = None
) -> None:
    """Binary little-endian PLY of every frame, `frame_00000.ply` …; single precision, axes and unit of the tracks."""
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("index", "<i4", (faces.shape[1],))])
    rows["count"], rows["index"] = faces.shape[1], faces
    depth = "away from" if y_axis == "down" else "towards"
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment x right, y {y_axis}, z {depth} the first camera; unit of the tracks\n"
        f"element vertex {shapes.shape[1]}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    tail = rows.tobytes()
    frames = (head + shape.astype("<f4").tobytes() + tail for shape in shapes)
    _write_members(file, frames, len(shapes), "ply", on_progress)


def _write_members(
    file: IO[bytes], frames: Iterable[bytes], count: int, suffix: str, on_progress: Callable[[float], None] | None
) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for index, content in enumerate(frames):
            # A fixed date, so that equal results are equal files.
            archive.writestr(
                zipfile.ZipInfo(f"frame_{index:05d}.{suffix}", FIRST_DAY), content, zipfile.ZIP_DEFLATED, 1
            )
            if on_progress is not None:
                on_progress((index + 1) / count)

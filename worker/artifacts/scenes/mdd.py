"""The moving points as a Lightwave MDD point cache, which Blender (Mesh Cache), Maya and Houdini read.

Layout, big-endian: int32 frames, int32 points, float32 seconds of every frame, then float32 x y z of every point, frame after frame
(LightWave 3D SDK, "Motion Designer MDD format").
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import IO

from pliant.worker.artifacts.result import Result


def write_mdd(result: Result, file: IO[bytes], on_progress: Callable[[float], None]) -> None:
    """Write every frame; y up, right-handed, unscaled; point p is vertex p of the mesh in the other files."""
    frames, points, _ = result.solution.shapes.shape
    file.write(struct.pack(">ii", frames, points))
    file.write(result.times.astype(">f4").tobytes())
    for frame in range(frames):
        file.write(result.standing(frame).astype(">f4").tobytes())
        on_progress((frame + 1) / frames)

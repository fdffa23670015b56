"""Small pictures of the tracked frames: `film_frames.bin`, which the web page shows beside the mesh.

Browsers may fail to decode a film or to show the exact frame of a track; they all decode JPEGs.

Layout, little-endian: `b"PLIANTFF"`, uint32 version, uint32 length of the header, the header as JSON in UTF-8
(`version`, `width` and `height` of the film in pixels, `offsets` of the F pictures and of the end of the file), the pictures.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pliant.tracking import Film

NAME = "film_frames.bin"
MEDIA_TYPE = "application/octet-stream"
DESCRIPTION = "Small pictures of the tracked frames, which the web page shows beside the mesh."

MAGIC = b"PLIANTFF"
VERSION = 1
STRIP_SIDE = 480
"""Longest side of a picture, pixels: about its size on the page."""

MOST_BYTES = 40_000_000
"""Maximum size of the file, bytes, reached at about 2,000 frames. Longer films have no strip, because it would delay the page."""

QUALITY = 80
"""JPEG quality: no visible blocks at this size, about 20 kB per picture."""


def write_frames(film: Film, indices: NDArray[np.int64], path: Path) -> bool:
    """Decode a film again and write pictures of its frames `indices (F,)`, ascending, counted from 0 in the complete film.

    Returns False and writes no file if the pictures exceed `MOST_BYTES` or a frame is missing.
    """
    from pliant.tracking.contact_sheet import small_jpeg

    wanted = {int(index) for index in indices}
    pictures: list[bytes] = []
    for frame in film.frames():
        if frame.index in wanted:
            pictures.append(small_jpeg(frame.image, longest_side=STRIP_SIDE, quality=QUALITY))
        if sum(map(len, pictures)) > MOST_BYTES:
            return False
    if len(pictures) != len(wanted):
        return False
    path.write_bytes(packed(pictures, film.size))
    return True


def packed(pictures: Iterable[bytes], size: tuple[int, int]) -> bytes:
    """Return the bytes of the file, from JPEGs of a film of `size` (width, height) pixels."""
    parts = list(pictures)
    ends = np.cumsum([0, *map(len, parts)])
    # The offsets depend on the header's length, and so on their own digits: padding to a fixed length avoids this.
    reserved = 200 + 12 * len(ends)
    header = {"version": VERSION, "width": size[0], "height": size[1], "offsets": (16 + reserved + ends).tolist()}
    text = json.dumps(header).encode().ljust(reserved)
    return MAGIC + struct.pack("<II", VERSION, reserved) + text + b"".join(parts)

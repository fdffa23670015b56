"""Small pictures of the tracked frames: `film_frames.bin`, which the web page shows beside the mesh.

Browsers cannot be relied on to decode a film, nor to show exactly the frame that a track belongs to; JPEGs they can.

Layout, little-endian: `b"PLIANTFF"`, uint32 version, uint32 length of the header, the header as JSON in UTF-8
(`version`, `width` and `height` of the film in pixels, `offsets` of the F pictures and of the file's end), the pictures.
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
"""Of a picture, pixels: about as large as the page shows it."""

MOST_BYTES = 40_000_000
"""Larger files (about 2,000 frames) would make the page wait; such films have none."""

QUALITY = 80
"""JPEG quality: no visible blocks at this size, about 20 kB a picture."""


def write_frames(film: Film, indices: NDArray[np.int64], path: Path) -> bool:
    """Decode a film once more and write the pictures of some of its frames: `indices (F,)`, ascending, from 0 in the whole film.

    Returns False, and writes no file, where the pictures take more than `MOST_BYTES` or not all frames are found again.
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
    """Return the file of pictures of a film of `size` (width, height) pixels."""
    parts = list(pictures)
    ends = np.cumsum([0, *map(len, parts)])
    # The offsets' own digits decide where the pictures begin: a header of fixed length settles that.
    room = 200 + 12 * len(ends)
    header = {"version": VERSION, "width": size[0], "height": size[1], "offsets": (16 + room + ends).tolist()}
    text = json.dumps(header).encode().ljust(room)
    return MAGIC + struct.pack("<II", VERSION, room) + text + b"".join(parts)

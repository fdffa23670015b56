"""The example film of the web page, rendered on request and once per process."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

NAME, TITLE, FILE = "film", "filmed face", "face.webm"
"""Name and title of the example, and its file: VP8 in WebM, which OpenCV encodes everywhere and every browser decodes."""


def available() -> bool:
    """Return True if OpenCV is installed, which renders and tracks films."""
    return find_spec("cv2") is not None


@cache
def film() -> bytes:
    """Return the film's bytes; the first call takes a few seconds."""
    from pliant.tracking.rendering.example_film import write_example_film

    with TemporaryDirectory(prefix="pliant-example-") as folder:
        return write_example_film(Path(folder) / FILE).read_bytes()


@cache
def region() -> tuple[tuple[float, float], ...]:
    """Return the corners of a polygon around the object in the film's first frame, for the option `region_polygon`."""
    from pliant.tracking.rendering.example_film import example_region

    return tuple((x, y) for x, y in example_region())

"""A mask picture as a mesh: the marked pixels are the points, row by row; neighbouring pixels are neighbours on the surface."""

from __future__ import annotations

import warnings
from typing import IO

import numpy as np
from PIL import Image, PngImagePlugin
from pliant.worker.formats.errors import damaged, too_large
from pliant.worker.formats.records import Arrays, Limits

MAX_PIXELS_A_POINT = 64


def read_png(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Return `mask (rows, columns)` of bool: pixels of a PNG that are neither black nor fully transparent are points.

    Raises
    ------
    InvalidInput
        Codes damaged_file, too_large.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture = PngImagePlugin.PngImageFile(stream)
            if picture.width * picture.height > MAX_PIXELS_A_POINT * limits.max_points:
                raise too_large(
                    field,
                    expected=f"at most {MAX_PIXELS_A_POINT * limits.max_points:,} pixels",
                    got=f"{picture.width} × {picture.height}",
                )
            values = np.asarray(picture.convert("RGBA"))  # not grey: dark colours would round to black
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise damaged(field, f"a PNG that cannot be read ({str(error)[:120]})") from error
    return {"mask": (values[..., :3] > 0).any(axis=2) & (values[..., 3] > 0)}

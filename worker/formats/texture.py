"""The texture of a surface: the film's template frame as JPEG, with texture coordinates of every point."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pliant.solver import InvalidInput

QUALITY = 90
"""JPEG quality, 1 to 95. Pillow's documentation puts high quality at 90; above 95 files grow without visible gain."""

MAX_SIDE = 65_500
"""Largest width or height of a JPEG that libjpeg writes, pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """A base-colour picture and its texture coordinates."""

    jpeg: bytes
    """The picture, encoded."""

    width: int
    height: int

    uv: NDArray[np.float32]
    """Shape `(P, 2)`, in [0, 1]: u right, v down, (0, 0) the picture's upper left corner, as in glTF."""

    @property
    def uv_up(self) -> NDArray[np.float32]:
        """The coordinates with v up, from the picture's lower left corner, as in OBJ, USD and Alembic."""
        return np.column_stack([self.uv[:, 0], 1 - self.uv[:, 1]])

    @classmethod
    def from_tracked(cls, template_rgb: ArrayLike, uv: ArrayLike) -> Texture:
        """Encode a template frame, uint8 RGB `(H, W, 3)`, with coordinates `(P, 2)` in [0, 1], u right, v down.

        Raises
        ------
        InvalidInput
            Wrong type or shape, or coordinates outside the picture.
        """
        from PIL import Image

        picture, places = np.asarray(template_rgb), np.array(uv, dtype=np.float32, order="C")
        if (
            picture.dtype != np.uint8
            or picture.ndim != 3
            or picture.shape[2] != 3
            or picture.size == 0
            or max(picture.shape) > MAX_SIDE
        ):
            raise InvalidInput(
                "wrong_shape", field="texture", expected=f"a picture (H, W, 3) of uint8, up to {MAX_SIDE:,} pixels a side",
                got=f"{picture.dtype} {picture.shape}",
                hint="Give the template frame as RGB.",
            )  # fmt: skip
        if places.ndim != 2 or places.shape[1] != 2:
            raise InvalidInput(
                "wrong_shape", field="texture.uv", expected="(P, 2)", got=str(places.shape), hint="Give u and v of every point.",
            )  # fmt: skip
        if not ((places >= 0) & (places <= 1)).all():
            raise InvalidInput(
                "out_of_range", field="texture.uv", expected="coordinates from 0 to 1",
                got=f"{int((~((places >= 0) & (places <= 1))).any(axis=1).sum())} points outside",
                hint="Divide pixel coordinates by the picture's size, and clip them.",
            )  # fmt: skip
        encoded = io.BytesIO()
        Image.fromarray(picture).save(encoded, "JPEG", quality=QUALITY)
        places.flags.writeable = False
        return cls(encoded.getvalue(), picture.shape[1], picture.shape[0], places)

    def at_points(self, points: NDArray[np.intp]) -> Texture:
        """Return the texture of some of the points, by their indices."""
        return replace(self, uv=self.uv[points])

    def colours(self) -> NDArray[np.float64]:
        """Return the colours `(P, 3)` of the points, sRGB in [0, 1], interpolated bilinearly in the picture."""
        from PIL import Image

        with Image.open(io.BytesIO(self.jpeg)) as image:
            picture = np.asarray(image.convert("RGB"), dtype=np.float64) / 255
        # Texture coordinates measure from the corner; the centre of the first texel is half a texel inside.
        last = np.array([self.width, self.height]) - 1
        places = np.clip(self.uv * (last + 1.0) - 0.5, 0, last)
        first = np.floor(places).astype(np.intp)
        share = (places - first)[:, :, None]
        (left, top), (right, bottom) = first.T, np.minimum(first + 1, last).T
        upper = picture[top, left] * (1 - share[:, 0]) + picture[top, right] * share[:, 0]
        lower = picture[bottom, left] * (1 - share[:, 0]) + picture[bottom, right] * share[:, 0]
        return np.asarray(upper * (1 - share[:, 1]) + lower * share[:, 1])

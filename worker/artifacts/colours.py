"""Errors as colours, on one scale for the whole sequence, the same as in the web page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.worker.artifacts.geometry import Floats

SCALE = ("2b2f77", "28608f", "1f8f8a", "58b96d", "b5d44a", "fbe94b")
"""Six evenly spaced colours (sRGB) of increasing lightness, readable in greyscale and with colour blindness."""

STOPS = np.array([[int(text[i : i + 2], 16) / 255 for i in (0, 2, 4)] for text in SCALE])
TOP_SHARE = 0.99
UNKNOWN = 0.5
"""Grey of hidden positions, except where the colour is the distance from the truth."""


@dataclass(frozen=True, slots=True, eq=False)
class Painting:
    """Values to show as colours."""

    quantity: str
    """Name of the quantity."""

    values: Floats
    """Shape `(F, P)`, not negative, in `unit`."""

    known: NDArray[np.bool_] | None
    """Shape `(F, P)`: where there is a value; None if everywhere."""

    unit: str
    """Unit of the values."""

    top: float
    """The value of the brightest colour: the 99th percentile, so that a few outliers do not darken all others."""

    @classmethod
    def of(
        cls, quantity: str, values: Floats, known: NDArray[np.bool_] | None = None, *, unit: str = "the tracks' unit"
    ) -> Painting:
        """Choose the scale for values `(F, P)`."""
        counted = values.ravel() if known is None else values[known]
        top = float(np.quantile(counted, TOP_SHARE)) if counted.size else 0.0
        return cls(quantity, values, known, unit, top if top > 0 else 1.0)

    def frame(self, index: int) -> Floats:
        """Return the colours `(P, 3)` of one frame, sRGB in [0, 1]."""
        colours = shade(self.values[index] / self.top)
        if self.known is not None:
            colours[~self.known[index]] = UNKNOWN
        return colours

    def mean(self) -> Floats:
        """Return the colours `(P, 3)` of the mean over the frames that have a value, sRGB in [0, 1]."""
        if self.known is None:
            return shade(self.values.mean(axis=0) / self.top)
        count = self.known.sum(axis=0)
        total = np.einsum("fp,fp->p", self.values, self.known)
        colours = shade(total / np.maximum(count, 1) / self.top)
        colours[count == 0] = UNKNOWN
        return colours

    def legend(self) -> dict[str, Any]:
        """Return the legend of the colours for the report and the files."""
        scale = ["#" + text for text in SCALE]
        return {"colours": {"quantity": self.quantity, "unit": self.unit, "top": self.top, "scale": scale}}


def shade(share: Floats) -> Floats:
    """Return the colours `(N, 3)`, sRGB, of values `(N,)` as shares of the scale; the brightest above 1."""
    place = np.clip(share, 0, 1) * (len(STOPS) - 1)
    return np.stack([np.interp(place, np.arange(len(STOPS)), STOPS[:, i]) for i in range(3)], axis=1)


def linear(colours: Floats) -> Floats:
    """Decode sRGB to linear light (IEC 61966-2-1), which glTF and USD want."""
    return np.asarray(np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4))

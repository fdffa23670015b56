"""Colours for the gallery's face: skin, brows, eyes and lips, so that a rendered film shows what it is."""

from __future__ import annotations

import numpy as np
from pliant.solver.gallery.layout import disc
from pliant.solver.gallery.relief import neutral, rise, spot
from pliant.tracking.rendering.rasterising import Floats

SKIN, CHEEK, LIPS = (216.0, 172.0, 148.0), (214.0, 146.0, 128.0), (168.0, 84.0, 84.0)
BROW, WHITE, IRIS = (92.0, 66.0, 52.0), (232.0, 228.0, 222.0), (64.0, 84.0, 96.0)
INSIDE = (96.0, 38.0, 42.0)
"""sRGB, 0–255; `INSIDE` is the inside of the mouth, visible when the jaw drops."""


def face_paint(num_points: int) -> Floats:
    """Return a colour for every vertex of `pliant.solver.gallery.face(…, num_points)`, shape `(P, 3)`, sRGB from 0 to 255."""
    flat, _ = disc(num_points, "grid")
    rest = neutral(flat * (1.0, -1.0))
    x, y = np.abs(rest[:, 0]), rest[:, 1]
    arch = 0.41 + 0.05 * np.cos((x - 0.27) * 5.0)
    brow = np.exp(-0.5 * ((y - arch) / 0.035) ** 2) * rise(x - 0.10, 0.06) * rise(0.46 - x, 0.08)
    almond = rise(0.050 * (1 - ((x - 0.29) / 0.125) ** 2) - np.abs(y - 0.25), 0.02)
    iris = rise(0.05 - np.hypot(x - 0.29, y - 0.25), 0.02) * almond
    mouth = rise(0.24 - x, 0.05) * rise(y + 0.525 - 0.8 * x**2, 0.03) * rise(-0.335 - 0.35 * x**2 - y, 0.03)
    inside = rise(0.19 - x, 0.05) * rise(0.022 - np.abs(y + 0.42), 0.02)
    cheek = spot(x, y, at=(0.42, -0.08), size=(0.16, 0.13))
    nostril = spot(x, y, at=(0.055, -0.15), size=(0.03, 0.02))
    colours = np.tile(np.array(SKIN), (len(rest), 1))
    layers = (
        (0.8 * cheek, CHEEK), (0.85 * mouth, LIPS), (inside, INSIDE), (0.9 * brow, BROW), (almond, WHITE), (iris, IRIS),
        (0.6 * nostril, BROW),
    )  # fmt: skip
    for share, colour in layers:
        colours += share[:, None] * (np.array(colour) - colours)
    return colours

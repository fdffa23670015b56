"""The neutral face as a height relief on a bent oval."""

from __future__ import annotations

import numpy as np
from pliant.solver.records import Floats


def spot(x: Floats, y: Floats, *, at: tuple[float, float], size: tuple[float, float], slant: float = 0.0) -> Floats:
    """Return a Gaussian bump of height 1; `slant` shears it, moving its centre by −slant in x per unit of y."""
    across = x - at[0] + slant * (y - at[1])
    return np.asarray(np.exp(-0.5 * ((across / size[0]) ** 2 + ((y - at[1]) / size[1]) ** 2)))


def rise(value: Floats, width: float) -> Floats:
    """Return a smooth step from 0 to 1 around `value = 0`."""
    return np.asarray(0.5 + 0.5 * np.tanh(value / (0.5 * width)))


def neutral(plane: Floats) -> Floats:
    """Return the unit disc bent into an oval, with the features of a face.

    Parameters
    ----------
    plane : array, shape (P, 2)
        Parameters in the unit disc, x right, y up.

    Returns
    -------
    array, shape (P, 3)
        Model units, x right, y up, z towards the viewer; chin at y = −1, hairline at y = 1.
    """
    y = plane[:, 1]
    # The face narrows from the cheekbones to the chin, and a little to the hairline.
    breadth = 0.80 - 0.20 * rise(-0.45 - y, 0.7) - 0.05 * rise(y - 0.6, 0.6)
    bend = 1.25 * plane[:, 0]
    x = breadth * np.sin(bend)
    profile = 0.10 - 0.16 * np.maximum(y - 0.35, 0) ** 2 / 0.42 - 0.16 * np.maximum(-0.70 - y, 0) ** 2 / 0.09
    z = profile + 0.62 * np.cos(bend) * (1 - 0.18 * rise(-0.5 - y, 0.5))
    return np.stack(
        [x, y, z + _eyes(np.abs(x), y) + _nose(np.abs(x), y) + _mouth(np.abs(x), y) + _rest(np.abs(x), y)], 1
    )


def _eyes(x: Floats, y: Floats) -> Floats:
    """Brow ridge, socket, eyeball and the opening between the lids; x is the distance from the midline."""
    arch = 0.41 + 0.05 * np.cos((x - 0.27) * 5.0)
    brow = 0.055 * np.exp(-0.5 * ((y - arch) / 0.045) ** 2) * rise(x - 0.09, 0.08) * rise(0.47 - x, 0.12)
    socket = -0.115 * spot(x, y, at=(0.28, 0.27), size=(0.13, 0.085))
    inner_corner = -0.050 * spot(x, y, at=(0.13, 0.25), size=(0.045, 0.07))
    ball = 0.095 * spot(x, y, at=(0.29, 0.255), size=(0.085, 0.062))
    crease = (
        -0.016 * np.exp(-0.5 * ((y - 0.335 + 1.6 * (x - 0.29) ** 2) / 0.012) ** 2) * rise(0.13 - np.abs(x - 0.29), 0.05)
    )
    # The open eye is almond-shaped and slightly recessed behind the lids.
    almond = 0.052 * np.maximum(1 - ((x - 0.29) / 0.125) ** 2, 0)
    opening = -0.030 * rise(almond - np.abs(y - 0.250 - 0.02 * (x - 0.29)), 0.022) * (almond > 0)
    return np.asarray(brow + socket + inner_corner + ball + crease + opening)


def _nose(x: Floats, y: Floats) -> Floats:
    """Bridge, tip, wings and nostrils."""
    along = np.clip((0.33 - y) / 0.45, 0, 1)
    height = 0.05 * rise(0.50 - y, 0.2) + 0.21 * along**1.3
    width = 0.050 + 0.022 * along
    # The underside is rounded: it starts higher beside the tip than below it.
    underside = rise(y + 0.145 - 4.0 * x**2, 0.085)
    bridge = height * underside * np.exp(-0.5 * (x / width) ** 2)
    tip = 0.065 * spot(x, y, at=(0.0, -0.075), size=(0.055, 0.055))
    wing = 0.085 * spot(x, y, at=(0.105, -0.100), size=(0.034, 0.042))
    nostril = -0.050 * spot(x, y, at=(0.055, -0.145), size=(0.024, 0.016))
    return np.asarray(bridge + tip + wing + nostril)


def _mouth(x: Floats, y: Floats) -> Floats:
    """Both lips, the line between them, the groove above and the fold below."""
    end = rise(0.235 - x, 0.07)
    bow = -0.355 + 0.018 * np.exp(-0.5 * ((x - 0.06) / 0.035) ** 2) - 0.35 * x**2
    upper = 0.060 * np.exp(-0.5 * ((y - bow) / 0.034) ** 2) * end
    lower = 0.075 * np.exp(-0.5 * ((y + 0.490 - 0.5 * x**2) / 0.042) ** 2) * rise(0.20 - x, 0.10)
    line = -0.050 * np.exp(-0.5 * ((y + 0.420) / 0.013) ** 2) * rise(0.255 - x, 0.05)
    groove = -0.020 * spot(x, y, at=(0.0, -0.265), size=(0.025, 0.05))
    muzzle = 0.060 * spot(x, y, at=(0.0, -0.38), size=(0.20, 0.16))
    corner = -0.020 * spot(x, y, at=(0.265, -0.43), size=(0.03, 0.04))
    fold = -0.050 * spot(x, y, at=(0.0, -0.60), size=(0.15, 0.045))
    return np.asarray(upper + lower + line + groove + muzzle + corner + fold)


def _rest(x: Floats, y: Floats) -> Floats:
    """Chin, cheekbones, the hollows below them, the folds beside the nose, the temples."""
    chin = 0.085 * spot(x, y, at=(0.0, -0.77), size=(0.13, 0.10))
    bone = 0.055 * spot(x, y, at=(0.44, 0.08), size=(0.13, 0.10))
    hollow = -0.030 * spot(x, y, at=(0.45, -0.32), size=(0.12, 0.16))
    fold = -0.022 * spot(x, y, at=(0.215, -0.24), size=(0.03, 0.11), slant=0.45)
    temple = -0.030 * spot(x, y, at=(0.60, 0.48), size=(0.10, 0.16))
    return np.asarray(chin + bone + hollow + fold + temple)

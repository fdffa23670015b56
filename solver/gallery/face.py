"""A synthetic face that smiles, talks, raises its brows and blinks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver.gallery.layout import Kind, disc
from pliant.solver.gallery.relief import neutral, rise, spot
from pliant.solver.gallery.sequence import Sequence, film, sweep
from pliant.solver.records import Floats

MOUTH = -0.42
"""Height of the line between the lips; model units, y up, the face reaches from −1 (chin) to 1 (hairline)."""


@dataclass(frozen=True, slots=True)
class Expression:
    """Strength of each facial movement at one time, in [0, 1]."""

    smile: float
    jaw: float
    brows: float
    blink: float
    pucker: float


def face(
    num_frames: int = 60,
    num_points: int = 5000,
    *,
    degrees: float = 30.0,
    tilt: float = 10.0,
    scale_change: float = 0.0,
    mesh: Kind = "grid",
    self_occlusion: bool = False,
    seed: int = 0,
) -> Sequence:
    """Return a sequence of a moving face.

    The neutral face is a bent oval with brows, sockets, lids, nose, cheeks, lips and chin as relief, deformed by five
    expressions. The jaw rotates, the lids slide over the eyes and the lips part, so the shapes are not a linear model:
    no small number of basis shapes explains them exactly.

    Parameters
    ----------
    num_frames : int
        F, number of frames.
    num_points : int
        P, number of points.
    degrees : float
        The camera turns about the vertical from −degrees to +degrees.
    tilt : float
        The camera nods by ±tilt degrees.
    scale_change : float
        Amplitude of the change of the logarithm of the scale.
    mesh : str
        "grid": a pixel grid cut to an oval; "triangles": an irregular triangulation.
    self_occlusion : bool
        Hide points whose surface faces away from the camera; occlusion of the cheek by the nose is not modelled.
    seed : int
        Seed of the order and strength of the expressions.

    Raises
    ------
    InvalidInput
        F < 3, P < 4, an unknown mesh, or a scale change outside [0, 1].
    """
    flat, neighbours = disc(num_points, mesh)
    rest = neutral(flat * (1.0, -1.0))
    script = np.random.default_rng(seed).uniform(0, 1, (5, 2))

    def surface(time: float) -> Floats:
        return express(rest, _act(script, time)) * (1.0, -1.0, -1.0)

    cameras = sweep(num_frames, degrees, tilt=tilt)
    return film("face", surface, neighbours, cameras, scale_change=scale_change, self_occlusion=self_occlusion)


def _act(script: Floats, time: float) -> Expression:
    """Return smooth waves of different periods with seeded phases; blinks are short."""
    periods = np.array([1.0, 3.0, 1.5, 2.0, 1.0])
    waves = 0.5 - 0.5 * np.cos(2 * np.pi * (periods * time + script[:, 0]))
    strength = 0.75 + 0.25 * script[:, 1]
    smile, jaw, brows, _, pucker = waves * strength
    return Expression(smile, jaw * (1 - 0.5 * pucker), brows, waves[3] ** 6, max(0.0, pucker - smile))


def express(rest: Floats, expression: Expression) -> Floats:
    """Return the face with an expression.

    Parameters
    ----------
    rest : array, shape (P, 3)
        Neutral face; model units, x right, y up, z towards the viewer.
    expression
        Strength of each movement.
    """
    moved = rest.copy()
    _blink(moved, rest, expression.blink)
    _brows(moved, rest, expression.brows)
    _smile(moved, rest, expression.smile)
    _pucker(moved, rest, expression.pucker)
    _jaw(moved, rest, expression.jaw)
    return moved


def _blink(moved: Floats, rest: Floats, strength: float) -> None:
    """Slide the upper lid down over the eyeball: the lid bulges where the open eye was recessed."""
    x, y = np.abs(rest[:, 0]), rest[:, 1]
    moved[:, 1] -= 0.075 * strength * spot(x, y, at=(0.29, 0.30), size=(0.13, 0.035))
    moved[:, 2] += 0.030 * strength * spot(x, y, at=(0.29, 0.25), size=(0.10, 0.045))


def _brows(moved: Floats, rest: Floats, strength: float) -> None:
    """Raise the brows; the forehead wrinkles."""
    x, y = np.abs(rest[:, 0]), rest[:, 1]
    lift = spot(x, y, at=(0.28, 0.43), size=(0.22, 0.12))
    moved[:, 1] += 0.085 * strength * lift
    moved[:, 2] += 0.015 * strength * lift
    wrinkles = np.cos(2 * np.pi * (y - 0.02 * np.cos(6 * x)) / 0.115) * spot(x, y, at=(0, 0.68), size=(0.34, 0.12))
    moved[:, 2] += 0.010 * strength * wrinkles


def _smile(moved: Floats, rest: Floats, strength: float) -> None:
    """Pull the corners of the mouth out, up and back; the cheeks rise, the folds beside the nose deepen."""
    x, y = np.abs(rest[:, 0]), rest[:, 1]
    side = np.sign(rest[:, 0])
    corner = spot(x, y, at=(0.25, MOUTH), size=(0.12, 0.12))
    cheek = spot(x, y, at=(0.36, -0.08), size=(0.15, 0.14))
    fold = spot(x, y, at=(0.28, -0.24), size=(0.035, 0.13), slant=0.45)
    moved[:, 0] += strength * side * (0.115 * corner + 0.02 * cheek)
    moved[:, 1] += strength * (0.105 * corner + 0.055 * cheek)
    moved[:, 2] += strength * (0.075 * cheek - 0.050 * corner - 0.035 * fold)
    moved[:, 2] -= 0.025 * strength * spot(x, y, at=(0.0, MOUTH), size=(0.16, 0.10))


def _pucker(moved: Floats, rest: Floats, strength: float) -> None:
    """Draw the lips together and push them forward."""
    x, y = rest[:, 0], rest[:, 1]
    mouth = spot(x, y, at=(0.0, MOUTH), size=(0.20, 0.13))
    moved[:, 0] -= 0.38 * strength * mouth * x
    moved[:, 2] += 0.085 * strength * mouth


def _jaw(moved: Floats, rest: Floats, strength: float) -> None:
    """Turn the lower face about the axis through the ears; between the lips the surface sinks in."""
    x, y = np.abs(rest[:, 0]), rest[:, 1]
    # Sharp between the lips, smooth from the corners of the mouth to the cheeks.
    inner = rise(0.24 - x, 0.10)
    below = inner * rise(MOUTH - y, 0.035) + (1 - inner) * rise(MOUTH + 0.14 - y, 0.30)
    angle = 0.34 * strength * below
    height, depth = moved[:, 1] - 0.05, moved[:, 2] + 0.10
    turned = np.cos(angle) * height - np.sin(angle) * depth
    moved[:, 2] = np.sin(angle) * height + np.cos(angle) * depth - 0.10
    moved[:, 1] = turned + 0.05
    moved[:, 2] -= 0.22 * strength * spot(x, y, at=(0.0, MOUTH), size=(0.14, 0.026))

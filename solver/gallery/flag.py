"""A synthetic flag in the wind: cloth that bends without stretching."""

from __future__ import annotations

import numpy as np
from pliant.solver.gallery.layout import Kind, rectangle
from pliant.solver.gallery.sequence import Sequence, film, sweep
from pliant.solver.records import Floats

ASPECT = 1.5
QUADRATURE = 32
"""Gauss–Legendre nodes along the cloth; with these, chords exceed their arcs by less than 2e-6 for the waves below."""


def flag(
    num_frames: int = 60,
    num_points: int = 4000,
    *,
    degrees: float = 40.0,
    tilt: float = 12.0,
    scale_change: float = 0.0,
    mesh: Kind = "grid",
    self_occlusion: bool = False,
    seed: int = 0,
) -> Sequence:
    """Return a sequence of a waving flag.

    Each horizontal thread is a curve with tangent angle `θ(s, v, t)`, a travelling wave whose amplitude grows with the
    distance s from the pole. Points follow by integration, `x = ∫cos θ ds`, `z = ∫sin θ ds`, so these threads do not
    stretch. The phase depends on v, which shears the cloth.

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
        "grid" or "triangles".
    self_occlusion : bool
        Hide points whose surface faces away from the camera.
    seed : int
        Seed of the wind.

    Raises
    ------
    InvalidInput
        F < 3, P < 4, an unknown mesh, or a scale change outside [0, 1].
    """
    flat, neighbours = rectangle(num_points, mesh, aspect=ASPECT)
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, 4)
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
    length = (flat[:, 0] + 1) * ASPECT
    along = length[:, None] * (nodes + 1) / 2

    def surface(time: float) -> Floats:
        angle = _slope(along, flat[:, 1:], time, phases)
        x = length / 2 * (np.cos(angle) @ weights)
        z = length / 2 * (np.sin(angle) @ weights)
        sag = 0.08 * (length / (2 * ASPECT)) ** 2 * (1 + 0.4 * np.sin(2 * np.pi * time + phases[3]))
        return np.stack([x - ASPECT, flat[:, 1] + sag, z], axis=1)

    cameras = sweep(num_frames, degrees, tilt=tilt)
    return film("flag", surface, neighbours, cameras, scale_change=scale_change, self_occlusion=self_occlusion)


def _slope(along: Floats, height: Floats, time: float, phases: Floats) -> Floats:
    """Return the angle between the cloth's tangent and the image plane, radians."""
    growth = 0.25 + 0.75 * (1 - np.exp(-along / 0.8))
    main = 0.85 * np.sin(3.6 * along - 4 * np.pi * time + 0.5 * height + phases[0])
    fold = 0.35 * np.sin(7.1 * along - 6 * np.pi * time - 1.1 * height + phases[1])
    gust = 0.20 * np.sin(2 * np.pi * time + phases[2])
    return np.asarray(growth * (main + fold) + gust)

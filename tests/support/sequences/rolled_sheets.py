"""Sheets rolled up in closed form and seen by a pinhole camera: exactly isometric, or stretched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver import Tracks
from pliant.solver.model.so3 import exponential

FOCAL = 600.0
CENTRE = (319.5, 239.5)
SIZE = (640, 480)


@dataclass(frozen=True)
class RolledSheet:
    """A sheet before a camera."""

    points: NDArray[np.float64]
    """Camera axes, shape `(F, P, 3)`."""

    tracks: Tracks
    flat: NDArray[np.float64]
    """Positions in the sheet, shape `(P, 2)`."""


def rolled(kind: str = "cylinder", *, frames: int = 8, side: int = 8, stretch: float = 0.0) -> RolledSheet:
    """Roll a square sheet of side 2 onto a cylinder or a cone, more in every frame, and turn it before the camera.

    A cone of apex angle sin α = `1 / k` maps the flat polar coordinates (r, φ) to radius r / k and angle k φ. `stretch` lengthens one
    direction by up to that share, differently in every frame.
    """
    u, v = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-0.8, 0.8, side))
    flat = np.stack([u.ravel(), v.ravel()], axis=1)
    shapes = []
    for frame in range(frames):
        phase = 2 * np.pi * frame / frames
        x, y = flat.T.copy()
        x = x * (1 + stretch * np.sin(2.3 * phase + 0.4))
        if kind == "cylinder":
            bend = 0.3 + 0.7 * np.abs(np.sin(phase / 2 + 0.3))
            angle = 0.6 * np.sin(phase)  # of the rulings in the sheet
            along, across = x * np.cos(angle) + y * np.sin(angle), -x * np.sin(angle) + y * np.cos(angle)
            shape = np.stack([np.sin(bend * along) / bend, across, (1 - np.cos(bend * along)) / bend], axis=1)
        else:
            k = 1.3 + 0.7 * np.sin(phase / 2)
            radius, polar = np.hypot(x, y + 3), np.arctan2(x, y + 3)
            height = radius * np.sqrt(1 - 1 / k**2)
            shape = np.stack([radius / k * np.sin(k * polar), height, radius / k * np.cos(k * polar)], axis=1)
        shape = shape - shape.mean(axis=0)
        turn = exponential(np.array([0.45 * np.sin(phase), 0.5 * np.cos(1.3 * phase), 0.2 * np.sin(0.7 * phase)]))
        shapes.append(shape @ turn.T + np.array([0.2 * np.cos(phase), 0.1 * np.sin(phase), 4.5 + 0.4 * np.sin(phase)]))
    points = np.array(shapes)
    image = FOCAL * points[..., :2] / points[..., 2:] + np.array(CENTRE)
    return RolledSheet(points, Tracks.from_arrays(image), flat)


def one_scale_error(points: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Mean over frames of the relative error after one scale for the sequence and a rigid motion per frame."""
    moved, fixed = points - points.mean(axis=1, keepdims=True), truth - truth.mean(axis=1, keepdims=True)
    left, _, right = np.linalg.svd(fixed.transpose(0, 2, 1) @ moved)
    left[:, :, 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))[:, None]
    moved = moved @ (left @ right).transpose(0, 2, 1)
    moved *= (moved * fixed).sum() / (moved * moved).sum()
    return float((np.linalg.norm(moved - fixed, axis=(1, 2)) / np.linalg.norm(fixed, axis=(1, 2))).mean())

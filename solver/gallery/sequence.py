"""A synthetic sequence: tracks of a moving surface from a moving orthographic camera, with ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.errors import InvalidInput
from pliant.solver.mesh import Mesh
from pliant.solver.records import Floats, Tracks, read_only

PIXELS = 200.0
"""Image pixels per model unit, which is half the height of a face or flag, or the radius of a sphere."""

IMAGE_CENTRE = (320.0, 240.0)
GRAZING = 0.05
"""Minimum sine of the angle between a visible vertex's surface and the viewing direction."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Sequence:
    """A synthetic sequence: `tracks = scales · shapes · rotations[:, :2]ᵀ + translation` exactly, unless corrupted."""

    tracks: Tracks
    """F frames of P points, pixels."""

    mesh: Mesh
    """Mesh of the points."""

    shapes: Floats
    """True shapes, `(F, P, 3)`, world axes, pixels."""

    rotations: Floats
    """True cameras, `(F, 3, 3)`, camera from world."""

    scales: Floats
    """True scales, `(F,)`; the mean logarithm is 0."""

    name: str
    """Name of the surface, such as `face`."""

    outliers: NDArray[np.bool_]
    """Mask of the observations that `corrupt` replaced by outliers, `(F, P)`."""

    def __repr__(self) -> str:
        return f"<Sequence {self.name}: {self.tracks}>"


def sweep(num_frames: int, degrees: float, *, tilt: float) -> Floats:
    """Return cameras that rotate uniformly from −`degrees` to +`degrees` about the vertical and nod by ±`tilt` degrees.

    The nod (one period) and a roll of a third of it avoid rotation about a single axis.

    Returns
    -------
    array, shape (F, 3, 3)
        Camera from world, `roll · nod · turn`.
    """
    time = np.arange(num_frames) / max(num_frames - 1, 1)
    turn = np.radians(degrees) * (2 * time - 1)
    nod = np.radians(tilt) * np.sin(2 * np.pi * time)
    roll = np.radians(tilt) / 3 * np.sin(4 * np.pi * time)
    return np.asarray(about(2, roll) @ about(0, nod) @ about(1, turn))


def film(
    name: str,
    surface: Callable[[float], Floats],
    mesh: Mesh,
    rotations: Floats,
    *,
    scale_change: float,
    self_occlusion: bool,
) -> Sequence:
    """Return the sequence of a moving surface seen by the given cameras.

    Parameters
    ----------
    name
        Name of the sequence.
    surface
        Function of the time in [0, 1] that returns the points, `(P, 3)`, model units, image axes.
    mesh
        Mesh of the points.
    rotations
        Cameras, `(F, 3, 3)`, camera from world.
    scale_change
        Amplitude c of one sinusoidal period in the logarithm of the scale: the size in the image varies by e^±c.
    self_occlusion
        Hide points whose surface faces away from the camera. Exact only for convex bodies.

    Raises
    ------
    InvalidInput
        F < 3 or P < 4, or a scale change outside [0, 1].
    """
    if not 0 <= scale_change <= 1:
        raise refusal("scale_change", "a number from 0 to 1", scale_change)
    num_frames = len(rotations)
    times = np.arange(num_frames) / max(num_frames - 1, 1)
    shapes = PIXELS * np.stack([surface(float(time)) for time in times])
    log_scales = scale_change * np.sin(2 * np.pi * times + 0.7)
    scales = np.exp(log_scales - log_scales.mean())
    drift = np.stack([24 * np.sin(2 * np.pi * times), 15 * np.cos(2 * np.pi * times)], axis=1)
    points = scales[:, None, None] * (shapes @ rotations[:, :2].transpose(0, 2, 1)) + (drift + IMAGE_CENTRE)[:, None]
    seen = facing(shapes, mesh, rotations) if self_occlusion else None
    for array in (shapes, rotations, scales):
        read_only(array)
    tracks = Tracks.from_arrays(points, seen)
    return Sequence(tracks, mesh, shapes, rotations, scales, name, np.zeros(points.shape[:2], dtype=bool))


def facing(shapes: Floats, mesh: Mesh, rotations: Floats) -> NDArray[np.bool_]:
    """Return a mask of the points that face the camera, shape `(F, P)`; the viewing direction is +z."""
    depth = np.stack([vertex_normals(shape, mesh) @ turn[2] for shape, turn in zip(shapes, rotations, strict=True)])
    return np.asarray(depth < -GRAZING)


def vertex_normals(points: Floats, mesh: Mesh) -> Floats:
    """Return area-weighted unit vertex normals, `(P, 3)`, outward for counter-clockwise faces."""
    corners = points[mesh.faces]
    across = (corners[:, 1] - corners[:, -1], corners[:, 2] - corners[:, 0])
    normals = np.cross(*across) if mesh.faces.shape[1] == 4 else np.cross(corners[:, 1] - corners[:, 0], across[1])
    total = np.stack(
        [
            np.bincount(mesh.faces.ravel(), np.repeat(normals[:, axis], mesh.faces.shape[1]), len(points))
            for axis in range(3)
        ],
        axis=1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.divide(total, length, out=np.zeros_like(total), where=length > 0))


def refusal(name: str, expected: str, got: object) -> InvalidInput:
    """Return the error for an argument that is out of range."""
    return InvalidInput("out_of_range", field=name, expected=expected, got=repr(got), hint="Correct the argument.")


def about(axis: int, angles: Floats) -> Floats:
    """Return rotations about one axis, shape `(F, 3, 3)`."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrices = np.tile(np.eye(3), (len(angles), 1, 1))
    matrices[:, first, first] = matrices[:, second, second] = np.cos(angles)
    matrices[:, first, second] = -np.sin(angles)
    matrices[:, second, first] = np.sin(angles)
    return matrices

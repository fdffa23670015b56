"""A pulsating sphere: a closed body, half of which is always hidden from the camera."""

from __future__ import annotations

import numpy as np
from pliant.solver.gallery.sequence import Sequence, film, refusal, sweep
from pliant.solver.mesh import Mesh
from pliant.solver.records import MIN_POINTS, Floats, Ints

LOBES = 5


def sphere(
    num_frames: int = 60,
    num_points: int = 3000,
    *,
    degrees: float = 180.0,
    tilt: float = 15.0,
    scale_change: float = 0.0,
    self_occlusion: bool = True,
    seed: int = 0,
) -> Sequence:
    """Return a sequence of a pulsating sphere: its radius varies, and five lobes rise and sink with different periods.

    Points form a Fibonacci lattice, triangles its convex hull. By default the camera makes a full turn; with
    `self_occlusion` each point is hidden while it faces away, about half of the time.

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
    self_occlusion : bool
        Hide points whose surface faces away from the camera.
    seed : int
        Seed of the lobes.

    Raises
    ------
    InvalidInput
        F < 3, P < 4, or a scale change outside [0, 1].
    """
    if num_points < MIN_POINTS:
        raise refusal("num_points", f"at least {MIN_POINTS}", num_points)
    directions = _lattice(num_points)
    random = np.random.default_rng(seed)
    poles = random.standard_normal((LOBES, 3))
    poles /= np.linalg.norm(poles, axis=1, keepdims=True)
    bumps = np.exp(5.0 * (directions @ poles.T - 1.0))
    phases = random.uniform(0, 2 * np.pi, LOBES)
    rates = random.integers(1, 4, LOBES)

    def surface(time: float) -> Floats:
        breath = 1 + 0.12 * np.sin(4 * np.pi * time)
        lobes = bumps @ (0.22 * np.sin(2 * np.pi * rates * time + phases))
        return np.asarray(directions * (breath + lobes)[:, None])

    mesh = Mesh.from_faces(_outward(directions), num_points)
    cameras = sweep(num_frames, degrees, tilt=tilt)
    return film("sphere", surface, mesh, cameras, scale_change=scale_change, self_occlusion=self_occlusion)


def _lattice(num_points: int) -> Floats:
    """Return points distributed evenly over the unit sphere, `(P, 3)`."""
    index = np.arange(num_points) + 0.5
    height = 1 - 2 * index / num_points
    angle = np.pi * (1 + np.sqrt(5)) * index
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)


def _outward(points: Floats) -> Ints:
    """Return the faces of the convex hull, counter-clockwise seen from outside."""
    from scipy.spatial import ConvexHull  # imported here because listing the examples does not need it

    hull = ConvexHull(points)
    faces = hull.simplices.astype(np.int32)
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ti,ti->t", normals, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return np.asarray(faces)

"""Small scenes for the solver's tests: a waving sheet seen by a turning camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver import KnownCamera, Mesh, Settings, Tracks
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.energy.problem import Problem
from pliant.solver.shapes.setup import build_problem
from pliant.solver.tracks.normalization import normalize


def turning(num_frames: int, degrees: float) -> np.ndarray:
    """Rotations about the vertical axis from −degrees to degrees, with a nod."""
    turn = np.radians(np.linspace(-degrees, degrees, num_frames))
    nod = np.radians(10) * np.sin(np.linspace(0, 5, num_frames))
    zero, one = np.zeros(num_frames), np.ones(num_frames)
    about_y = np.array([[np.cos(turn), zero, np.sin(turn)], [zero, one, zero], [-np.sin(turn), zero, np.cos(turn)]])
    about_x = np.array([[one, zero, zero], [zero, np.cos(nod), -np.sin(nod)], [zero, np.sin(nod), np.cos(nod)]])
    return np.einsum("ijf,jkf->fik", about_x, about_y)


def sheet(num_frames: int = 8, rows: int = 7, columns: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """A grid whose surface waves: shapes (F, P, 3) centred, and the grid of point indices."""
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    time = np.linspace(0, 2, num_frames)[:, None, None]
    z = 0.5 * np.cos(2 * x) + 0.3 * np.sin(time) * np.sin(2 * x + y) + 0.1 * np.cos(time) * y**2
    shapes = np.stack(np.broadcast_arrays(x[None], y[None], z), axis=-1).reshape(num_frames, -1, 3)
    return shapes - shapes.mean(axis=1, keepdims=True), np.arange(rows * columns).reshape(rows, columns)


def project(shapes: np.ndarray, rotations: np.ndarray, scales: np.ndarray | float = 1.0) -> np.ndarray:
    scales = np.broadcast_to(scales, len(shapes))
    return np.einsum("f,fij,fpj->fpi", scales, rotations[:, :2], shapes)


def triangulated(grid: np.ndarray) -> Mesh:
    """Return the grid's cells cut into triangles, a mesh without grid structure."""
    a, b, c, d = (g.ravel() for g in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    keep = (np.stack([a, b, c, d]) >= 0).all(axis=0)
    return Mesh.from_faces(
        np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])[np.tile(keep, 2)], grid.max() + 1
    )


def small_problem(
    mesh: Mesh | None, seed: int = 0, *, hidden: float = 0.2, frames: int = 4, **settings: object
) -> Problem:
    """A noisy sheet with hidden points as an energy, for dense comparisons."""
    random = np.random.default_rng(seed)
    shapes, _ = sheet(frames)
    rotations = turning(frames, 40)
    points = project(shapes, rotations) + 0.02 * random.standard_normal((frames, shapes.shape[1], 2))
    visible = np.where(random.random(points.shape[:2]) < hidden, 0.0, random.uniform(0.5, 1, points.shape[:2]))
    options = {"temporal_weight": 0.05, "spatial_weight": 0.02, "robust_scale": 0.03, **settings}
    normalized = normalize(Tracks.from_arrays(points, visible))
    estimate = CameraEstimate(
        rotations, np.ones(frames), np.zeros((frames, 2)), 1, np.zeros((0, 0)), np.zeros((frames, 0, 2))
    )
    return build_problem(normalized, estimate, mesh, Settings(**options))[0]


def cameras_of(rotations: np.ndarray) -> KnownCamera:
    return KnownCamera.from_arrays(rotations, np.ones(len(rotations)))


def with_weights(problem: Problem, **changes: float) -> Problem:
    return replace(problem, weights=replace(problem.weights, **changes))

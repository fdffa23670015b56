"""Cameras from tracks: rotation, scale and translation of every frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from pliant.solver.normalise import Normalised
from pliant.solver.records import Floats, Step
from pliant.solver.settings import Settings


@dataclass(frozen=True, slots=True, eq=False)
class CameraEstimate:
    """The cameras, and how they were found."""

    rotations: Floats
    """Camera from world, shape `(F, 3, 3)`; the first is the identity."""
    scales: Floats
    """Shape `(F,)`, mean of the logarithm 0."""
    translations: Floats
    """Correction to the centroid, normalised units, shape `(F, 2)`."""
    basis_size: int
    reasons: dict[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def estimate_cameras(
    normalised: Normalised,
    settings: Settings,
    *,
    on_step: Callable[[Step], None] | None = None,  # noqa: ARG001
    should_stop: Callable[[], bool] | None = None,  # noqa: ARG001
) -> CameraEstimate:
    """Return rigid cameras: rank-3 factor and metric upgrade (Tomasi, Kanade 1992)."""
    frames = len(normalised.points)
    tracks = normalised.points.transpose(0, 2, 1).reshape(2 * frames, -1)
    values, vectors = np.linalg.eigh(tracks @ tracks.T)
    factor = vectors[:, -3:] * np.sqrt(np.maximum(values[-3:], 0))
    x, y = factor[0::2], factor[1::2]

    def row(a: Floats, b: Floats) -> Floats:
        mixed = np.stack([a[:, i] * b[:, j] + a[:, j] * b[:, i] * (i != j) for i in range(3) for j in range(i, 3)], 1)
        return np.asarray(mixed, dtype=np.float64)

    equations = np.concatenate([row(x, x) - row(y, y), row(x, y), row(x[:1], x[:1])])
    goal = np.zeros(len(equations))
    goal[-1] = 1
    q = np.linalg.lstsq(equations, goal, rcond=None)[0]
    gram = np.array([[q[0], q[1], q[2]], [q[1], q[3], q[4]], [q[2], q[4], q[5]]])
    value, vector = np.linalg.eigh(gram)
    upgraded = factor @ (vector * np.sqrt(np.maximum(value, 1e-9 * value[-1])))
    pairs = upgraded.reshape(frames, 2, 3)
    left, size, right = np.linalg.svd(pairs, full_matrices=False)
    rows = left @ right
    complete = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], axis=1)
    complete = complete @ complete[0].T
    scales = size.mean(axis=1)
    scales = np.ones(frames) if settings.camera == "orthographic" else scales / np.exp(np.log(scales).mean())
    return CameraEstimate(complete, scales, np.zeros((frames, 2)), 1, {"basis_size": "Rigid."})


def estimate_scales(normalised: Normalised, rotations: Floats) -> Floats:  # noqa: ARG001
    """Return scales for given rotations."""
    return np.ones(len(rotations))

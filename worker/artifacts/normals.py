"""Normals of a moving mesh, fitted to the weights of its modes.

A file could store the normals of every mode, each displaced by the full mode. Such normals are right to first order only, and take as
many bytes as the positions. Here the true normals of the frames are regressed on the weights instead: n_f ≈ b + Σ_k w_fk c_k for the
first r modes, with the smallest r whose error is within `NORMAL_BOUND`. On 99 face scans (9 modes) r = 4 has a mean error of 3.4°, all
nine modes to first order 5.9°.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.worker.artifacts.animation import Animation
from pliant.worker.artifacts.geometry import Ints, Singles, vertex_normals

NORMAL_BOUND = float(np.radians(5))
"""RMS length of the difference between fitted and true unit normals that decides the number of targets: 5°.
On 99 face scans it keeps 4 of 9 targets, with half the error of all 9 to first order."""

FRAMES_OF_FIT = 100
"""Evenly spaced frames in the fit, or four for each coefficient if that is more; bounds the time for long sequences."""

LEAST_LENGTH = 0.1
"""Length of the constant part b below which a vertex keeps its mean normal, because the division by it would amplify noise."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedNormals:
    """The normals of frame f have the direction of base + Σ_k weights[f, k] · targets[k]; further targets are zero."""

    base: Singles
    """Unit normals `(P, 3)`."""

    targets: Singles
    """Shape `(r, P, 3)`."""

    rms: float
    """RMS length of the difference from the true unit normals."""


def fit_normals(animation: Animation, triangles: Ints) -> FittedNormals:
    """Fit the normals of an animation in modes, with triangles `(T, 3)`, in one pass over its frames."""
    import scipy.linalg  # imported here, because the API process writes no files

    frames, modes = animation.weights.shape
    step = max(1, frames // max(FRAMES_OF_FIT, 4 * (modes + 1)))
    used = range(0, frames, step)
    design = np.column_stack([np.ones(len(used)), animation.weights[::step]])
    # With design = QR the fit on its first columns needs the first rows of QᵀN alone, so one pass serves every number of targets.
    q, r = scipy.linalg.qr(design, mode="economic")
    projected = np.zeros((q.shape[1], len(animation.base), 3), dtype=np.float32)
    for row, frame in zip(q, used, strict=True):
        normals = vertex_normals(animation.frame(frame), triangles)
        for sums, factor in zip(projected, row.astype(np.float32), strict=True):
            sums += factor * normals
    explained = np.array([float(np.vdot(sums, sums)) for sums in projected])
    left = np.maximum(1 - np.cumsum(explained) / (len(used) * len(animation.base)), 0)
    enough = np.flatnonzero(np.sqrt(left[1:]) <= NORMAL_BOUND)
    count = int(enough[0]) + 1 if len(enough) else len(left) - 1
    # The columns are linearly dependent if nothing moves, which the pseudo-inverse permits.
    inverse = np.linalg.pinv(r[: count + 1, : count + 1], rcond=1e-6).astype(np.float32)
    fitted = np.tensordot(inverse, projected[: count + 1], axes=1)
    mean = design.mean(axis=0)[: count + 1].astype(np.float32)
    base, targets = _unit_base(fitted, mean)
    return FittedNormals(base=base, targets=targets, rms=float(np.sqrt(left[count])))


def _unit_base(fitted: Singles, mean: Singles) -> tuple[Singles, Singles]:
    """Divide by the length of the constant part, as base normals of glTF have unit length and viewers normalise the sum."""
    length = np.linalg.norm(fitted[0], axis=1, keepdims=True)
    short = length[:, 0] < LEAST_LENGTH
    scaled = fitted / np.where(length < LEAST_LENGTH, 1, length)
    average = np.tensordot(mean, fitted[:, short], axes=1)
    sizes = np.linalg.norm(average, axis=1, keepdims=True)
    scaled[1:, short] = 0
    scaled[0, short] = np.where(sizes > LEAST_LENGTH, average / np.maximum(sizes, LEAST_LENGTH), (0, 0, 1))
    return scaled[0].astype(np.float32), scaled[1:].astype(np.float32)

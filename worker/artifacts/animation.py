"""A moving shape as morph targets: one a frame where there are few, modes of motion where there are many.

Viewers are right up to about 256 targets and slow beyond. Up to 200 frames each frame is its own target and the weights are one-hot, so
every frame is exact in single precision. Above, the frames minus their mean are expanded in principal components (SVD); the weights are the
coefficients, shifted and scaled into [0, 1] because viewers clamp weights to the slider's range (others come out wrong in Blender).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pliant.worker.artifacts.geometry import Floats, Singles

MAX_FRAME_TARGETS = 200
MAX_MODES = 200
BLOCK = 4096
ERROR_BOUND = 1e-3
"""Largest distance between a point and its place in the file that is allowed to modes, as a share of the bounding box's diagonal."""


@dataclass(frozen=True, slots=True, eq=False)
class Animation:
    """Points of frame f = base + Σ_k weights[f, k] · targets[k]."""

    base: Singles
    """Shape `(P, 3)`, what a viewer shows that does not animate."""

    targets: Singles
    """Shape `(K, P, 3)`, displacements."""

    weights: Singles
    """Shape `(F, K)`, in [0, 1]."""

    names: list[str]
    """One for each target."""

    extras: dict[str, Any]
    """What the file says of itself: encoding and error bound, in the tracks' unit."""

    def frame(self, index: int) -> Floats:
        """Points `(P, 3)` as a viewer computes them."""
        return self.base.astype(np.float64) + np.tensordot(self.weights[index].astype(np.float64), self.targets, axes=1)


def animate(shapes: Floats) -> Animation:
    """Encode shapes `(F, P, 3)` exactly, or within the bound where there are more than 200 frames."""
    return _per_frame(shapes) if len(shapes) <= MAX_FRAME_TARGETS else _modes(shapes)


def _per_frame(shapes: Floats) -> Animation:
    frames = len(shapes)
    base = shapes[0].astype(np.float32)
    targets = (shapes - base).astype(np.float32)
    worst = max(float(np.abs(base + target - shape).max()) for target, shape in zip(targets, shapes, strict=True))
    return Animation(
        base=base,
        targets=targets,
        weights=np.eye(frames, dtype=np.float32),
        names=[f"frame {index}" for index in range(frames)],
        extras={"encoding": "one target per frame", "targets": frames, "max_error": worst},
    )


def _modes(shapes: Floats) -> Animation:
    frames, count, _ = shapes.shape
    mean = shapes.mean(axis=0)
    moved = (shapes - mean).reshape(frames, -1)
    # The eigenvectors of the F × F Gram matrix are the left singular vectors; F is small beside 3P.
    values, vectors = np.linalg.eigh(moved @ moved.T)
    left = vectors[:, np.argsort(values)[::-1]]
    diagonal = float(np.linalg.norm(shapes.max(axis=(0, 1)) - shapes.min(axis=(0, 1))))
    allowed = ERROR_BOUND * diagonal
    kept = _smallest(moved, left, allowed)
    coefficients = left[:, :kept] * np.sqrt(frames)
    modes = (coefficients.T @ moved / frames).reshape(kept, count, 3)
    low, high = coefficients.min(axis=0), coefficients.max(axis=0)
    width = np.where(high > low, high - low, 1.0)
    made = Animation(
        base=(mean + np.tensordot(low, modes, axes=1)).astype(np.float32),
        targets=(modes * width[:, None, None]).astype(np.float32),
        weights=np.clip((coefficients - low) / width, 0, 1).astype(np.float32),
        names=[f"mode {index}" for index in range(kept)],
        extras={"encoding": "modes", "targets": kept, "error_bound": allowed},
    )
    errors = [np.linalg.norm(made.frame(index) - shapes[index], axis=1) for index in range(frames)]
    made.extras["max_error"] = float(max(error.max() for error in errors))
    made.extras["rms_error"] = float(np.sqrt(np.mean([np.mean(error**2) for error in errors])))
    return made


def _smallest(moved: Floats, left: Floats, allowed: float) -> int:
    """Few modes whose worst point is within 90 % of what is allowed (the rest is for rounding), by bisection; at most 200."""
    low, high = 1, min(MAX_MODES, int(left.shape[1]))
    while low < high:
        middle = (low + high) // 2
        if _worst(moved, left[:, :middle]) <= 0.9 * allowed:
            high = middle
        else:
            low = middle + 1
    return high


def _worst(moved: Floats, left: Floats) -> float:
    """Largest distance of a point from its projection on the modes; in blocks of points, to spare memory."""
    worst = 0.0
    for start in range(0, moved.shape[1], 3 * BLOCK):
        block = moved[:, start : start + 3 * BLOCK]
        rest = block - left @ (left.T @ block)
        worst = max(worst, float((rest.reshape(len(rest), -1, 3) ** 2).sum(axis=2).max()))
    return float(np.sqrt(worst))

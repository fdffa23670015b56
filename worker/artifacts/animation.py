"""A moving shape as morph targets: modes of motion, or one target per frame.

The frames minus their mean are expanded in principal components (SVD); the weights are the coefficients, shifted and scaled to [0, 1]
because viewers clamp weights to the range of their sliders (Blender does). The fewest modes are kept that bring every point of every frame
within a bound, always fewer than frames. On request each frame is its own target instead, with one-hot weights, exact in single
precision. Viewers handle about 256 targets correctly and slow down beyond, so more than 200 frames always become modes.

Targets are generated on demand, and operations over all frames process blocks of points, so that the memory beside the shapes is one
frame or the modes, never a copy of the sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from pliant.worker.artifacts.geometry import Floats, Singles, upright

MAX_FRAME_TARGETS = 200
MAX_MODE_TARGETS = 200
BLOCK = 1 << 21
"""Numbers in a block of points over all frames (16 MB)."""

OVERSAMPLING, SUBSPACE_ROUNDS = 10, 3
"""Additional vectors and rounds of the subspace iteration. The number of modes depends on their true errors, so an inaccurate vector can
only cost a further mode."""

ERROR_BOUND = 1e-3
"""Maximum error of a point's position due to modes, as a share of the bounding box's diagonal."""


@dataclass(frozen=True, slots=True, eq=False)
class Animation:
    """Points of frame f = base + Σ_k weights[f, k] · target(k)."""

    base: Singles
    """Shape `(P, 3)`, shown by viewers without animation."""

    target: Callable[[int], Singles]
    """Displacements `(P, 3)` of target k."""

    weights: Singles
    """Shape `(F, K)`, in [0, 1]."""

    names: list[str]
    """Names of the targets."""

    frame: Callable[[int], Floats]
    """Exact points `(P, 3)` of a frame, y up."""

    extras: dict[str, Any]
    """Metadata for the file: encoding and error bound, in the tracks' unit."""


def animate(shapes: Floats, *, y_axis: str = "up", motion: str = "auto") -> Animation:
    """Encode shapes `(F, P, 3)` in world axes, turned to y up.

    `motion="auto"` takes as few modes as keep every point within `ERROR_BOUND`; `frames` is exact, up to 200 frames.
    """
    if len(shapes) > MAX_FRAME_TARGETS:
        return _modes(shapes, y_axis, MAX_MODE_TARGETS)
    if motion == "frames" or len(shapes) < 3:
        return _per_frame(shapes, y_axis)
    return _modes(shapes, y_axis, len(shapes) - 1)  # enough for any motion, and still fewer than the frames


def _per_frame(shapes: Floats, y_axis: str) -> Animation:
    frames = len(shapes)
    base = upright(shapes[0], y_axis).astype(np.float32)

    def target(index: int) -> Singles:
        return (upright(shapes[index], y_axis) - base).astype(np.float32)

    worst = max(float(np.abs(base + target(index) - upright(shapes[index], y_axis)).max()) for index in range(frames))
    return Animation(
        base=base,
        target=target,
        weights=np.eye(frames, dtype=np.float32),
        names=[f"frame {index}" for index in range(frames)],
        frame=lambda index: upright(shapes[index], y_axis),
        extras={"encoding": "one target per frame", "targets": frames, "max_error": worst},
    )


def _modes(shapes: Floats, y_axis: str, most: int) -> Animation:
    frames, count, _ = shapes.shape
    mean = upright(shapes.mean(axis=0), y_axis)
    # The eigenvectors of the F × F Gram matrix are the left singular vectors.
    gram = np.zeros((frames, frames))
    for _, moved in _blocks(shapes, y_axis, mean):
        gram += moved @ moved.T
    left = leading(gram, most)
    allowed = ERROR_BOUND * float(np.linalg.norm(shapes.max(axis=(0, 1)) - shapes.min(axis=(0, 1))))
    kept = _smallest(shapes, y_axis, mean, left, allowed)
    coefficients = left[:, :kept] * np.sqrt(frames)
    low, high = coefficients.min(axis=0), coefficients.max(axis=0)
    width = np.where(high > low, high - low, 1.0)
    base, targets = np.zeros((count, 3), np.float32), np.zeros((kept, count, 3), np.float32)
    for some, moved in _blocks(shapes, y_axis, mean):
        modes = (coefficients.T @ moved / frames).reshape(kept, -1, 3)
        base[some] = mean[some] + np.tensordot(low, modes, axes=1)
        targets[:, some] = modes * width[:, None, None]
    weights = np.clip((coefficients - low) / width, 0, 1).astype(np.float32)
    worst, rms = _rounded_errors(shapes, y_axis, base, targets, weights)
    return Animation(
        base=base,
        target=lambda index: targets[index],
        weights=weights,
        names=[f"mode {index}" for index in range(kept)],
        frame=lambda index: upright(shapes[index], y_axis),
        extras={"encoding": "modes", "targets": kept, "error_bound": allowed, "max_error": worst, "rms_error": rms},
    )


def leading(gram: Floats, most: int) -> Floats:
    """Return the eigenvectors of the largest eigenvalues of a Gram matrix, as columns, largest first.

    For long films, subspace iteration is used (Halko, Martinsson, Tropp, "Finding structure with randomness", 2011, algorithm 4.4): SciPy's
    `eigh` would hold the interpreter's lock, for 2 s at 3,000 frames, so that no thread could report progress.
    """
    frames = len(gram)
    if frames <= MAX_FRAME_TARGETS:
        return np.asarray(np.linalg.eigh(gram)[1][:, ::-1][:, :most])
    basis = np.random.default_rng(0).standard_normal((frames, min(frames, most + OVERSAMPLING)))
    for _ in range(SUBSPACE_ROUNDS):
        basis = np.linalg.qr(gram @ basis)[0]
    return np.asarray(basis @ np.linalg.eigh(basis.T @ gram @ basis)[1][:, ::-1][:, :most])


def _blocks(shapes: Floats, y_axis: str, origin: Floats | Singles) -> Iterator[tuple[slice, Floats]]:
    """Yield displacements from one shape `(P, 3)`, y up, as `(F, 3 · points)`, a block of points at a time."""
    points = max(1, BLOCK // (3 * len(shapes)))
    for start in range(0, shapes.shape[1], points):
        some = slice(start, start + points)
        yield some, (upright(shapes[:, some], y_axis) - origin[some]).reshape(len(shapes), -1)


def _smallest(shapes: Floats, y_axis: str, mean: Floats, left: Floats, allowed: float) -> int:
    """Return the fewest modes, at most those given, whose maximum error is within 90 % of the bound, by bisection (10 % for rounding)."""
    low, high = 1, int(left.shape[1])
    while low < high:
        middle = (low + high) // 2
        if _within(0.9 * allowed, _blocks(shapes, y_axis, mean), left[:, :middle]):
            high = middle
        else:
            low = middle + 1
    return high


def _within(distance: float, blocks: Iterator[tuple[slice, Floats]], left: Floats) -> bool:
    """Return whether every point of every frame is within a distance of its projection on the modes."""
    for _, moved in blocks:
        rest = moved - left @ (left.T @ moved)
        if (rest.reshape(len(rest), -1, 3) ** 2).sum(axis=2).max() > distance**2:
            return False
    return True


def _rounded_errors(
    shapes: Floats, y_axis: str, base: Singles, targets: Singles, weights: Singles
) -> tuple[float, float]:
    """Return the maximum and RMS distance between points and their positions in a viewer, which uses the rounded numbers."""
    worst, total = 0.0, 0.0
    for some, moved in _blocks(shapes, y_axis, base):
        modes = targets[:, some].reshape(len(targets), -1).astype(np.float64)
        squared = np.square(moved - weights.astype(np.float64) @ modes).reshape(len(shapes), -1, 3).sum(axis=2)
        worst, total = max(worst, float(squared.max())), total + float(squared.sum())
    return float(np.sqrt(worst)), float(np.sqrt(total / shapes[..., 0].size))

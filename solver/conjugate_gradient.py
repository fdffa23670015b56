"""Preconditioned conjugate gradients on arrays of any layout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Where conjugate gradients stopped."""

    x: Array
    iterations: int
    relative: float
    """Preconditioned residual norm √(rᵀM⁻¹r) at the end over that at the start."""


def conjugate_gradient(
    apply: Callable[[Array], Array],
    b: Array,
    x: Array,
    *,
    precondition: Callable[[Array], Array],
    reduction: float,
    max_iterations: int,
    should_stop: Callable[[], bool] | None = None,
) -> Solved:
    """Improve x towards 𝒜 x = b for a symmetric positive (semi)definite 𝒜.

    Every iteration lowers ½ xᵀ𝒜x − bᵀx, so stopping early is always safe: an inexact inner solve inside
    majorise–minimise still descends. Stops when √(rᵀM⁻¹r) has
    fallen to `reduction` times its first value, or to rounding level beside √(bᵀM⁻¹b).
    Saad, Iterative Methods for Sparse Linear Systems (2003), algorithm 9.1.
    """
    residual = b - apply(x)
    z = precondition(residual)
    first = rz = _dot(residual, z)
    enough = max(reduction**2 * first, (10 * float(np.finfo(b.dtype).eps)) ** 2 * abs(_dot(b, precondition(b))))
    direction = z
    x = x.copy()
    done = 0
    while done < max_iterations and rz > enough:
        if should_stop is not None and should_stop():
            break
        image = apply(direction)
        curvature = _dot(direction, image)
        if not curvature > 0:  # a null direction: nothing more to gain along it
            break
        step = rz / curvature
        x += direction.dtype.type(step) * direction
        residual -= direction.dtype.type(step) * image
        z = precondition(residual)
        before, rz = rz, _dot(residual, z)
        direction = z + direction.dtype.type(rz / before) * direction
        done += 1
    return Solved(x, done, float(np.sqrt(max(rz, 0.0) / first)) if first > 0 else 0.0)


def _dot(one: Array, two: Array) -> float:
    """Inner product, frame by frame and then summed in double precision, which float32 needs."""
    frames = [float(np.vdot(a, b)) for a, b in zip(one, two, strict=True)]
    return float(np.sum(frames))

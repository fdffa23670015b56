"""Preconditioned conjugate gradients on arrays of any shape; threads split the first axis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pliant.solver.pulse import ShouldStop, never, pulse
from pliant.solver.records import Array
from pliant.solver.threads import SMALLEST, over_ranges


class Linear(Protocol):
    """A linear map of arrays."""

    def __call__(self, x: Array, /, out: Array | None = None) -> Array:
        """Return the image of x, written to `out` if it is given and the map supports it."""


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Result of conjugate gradients."""

    x: Array
    iterations: int
    decrease: float
    """Decrease of xᵀ𝒜x − 2bᵀx."""


def conjugate_gradient(
    apply: Linear,
    b: Array,
    *,
    precondition: Linear,
    reduction: float,
    max_iterations: int,
    negligible: float = 0.0,
    should_stop: ShouldStop = never,
) -> Solved:
    """Solve 𝒜 x = b, starting from 0, for a symmetric positive (semi)definite 𝒜; b is overwritten.

    Saad, Iterative Methods for Sparse Linear Systems (2003), algorithm 9.1. Every iteration decreases ½ xᵀ𝒜x − bᵀx, so
    majorise–minimise descends even if the inner solve stops early. Iterations end when √(rᵀM⁻¹r) has fallen to
    `reduction` times its initial value or to rounding level, or when rᵀM⁻¹r, an estimate of the remaining decrease of
    xᵀ𝒜x − 2bᵀx, is at most `negligible`. `should_stop` is called at the start, where its result is ignored, and in every
    iteration; once it returns True there, the current x is returned.

    Four arrays of the size of x are allocated once and reused, because page faults of new arrays in every iteration would
    cost more than the arithmetic; b is one of them. 𝒜 times the direction and the preconditioned
    residual share an array, as they are never needed at the same time.
    """
    x, residual, spare = np.zeros_like(b), b, np.empty_like(b)
    should_stop()  # to report progress: first touching gigabytes of memory takes as long as an iteration
    z = precondition(residual, out=spare)
    pulse()
    direction = np.empty_like(b)
    direction[...] = z
    rz = dot(residual, z)
    enough = max(negligible, max(reduction, 10 * float(np.finfo(b.dtype).eps)) ** 2 * rz)
    done, decrease = 0, 0.0
    while done < max_iterations and rz > enough:
        if should_stop():
            break
        image = apply(direction, out=spare)
        curvature = dot(direction, image)
        if not curvature > 0:  # null direction: no further decrease along it
            break
        decrease += rz * (rz / curvature)
        _advance(rz / curvature, direction, image, x=x, residual=residual)
        z = precondition(residual, out=spare)
        before, rz = rz, dot(residual, z)
        _turn(rz / before, z, direction)
        done += 1
    return Solved(x, done, decrease)


def _advance(step: float, direction: Array, image: Array, *, x: Array, residual: Array) -> None:
    """X += step · direction; residual −= step · image."""
    factor = x.dtype.type(step)

    def work(start: int, stop: int) -> None:
        spare = np.empty_like(x[start])
        for i in range(start, stop):
            np.multiply(direction[i], factor, out=spare)
            x[i] += spare
            np.multiply(image[i], factor, out=spare)
            residual[i] -= spare

    _over_slices(work, x)


def _turn(factor: float, z: Array, direction: Array) -> None:
    """Direction = z + factor · direction."""

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            direction[i] *= direction.dtype.type(factor)
            direction[i] += z[i]

    _over_slices(work, z)


def dot(one: Array, two: Array) -> float:
    """Return the inner product, computed per slice and summed in double precision, as single-precision arrays require.

    BLAS is avoided: its threads synchronise by busy waiting, which on a loaded machine takes longer than the sum.
    """
    parts = np.zeros(len(one))

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            parts[i] = np.einsum("i,i->", one[i].ravel(), two[i].ravel())

    _over_slices(work, one)
    return float(parts.sum())


def _over_slices(work: Callable[[int, int], None], array: Array) -> None:
    over_ranges(work, len(array), smallest=max(1, SMALLEST // max(array[0].size, 1)))

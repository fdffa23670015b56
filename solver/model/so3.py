"""Mathematics of SO(3), for stacks of rotations: exponential map, its Jacobian, logarithm, nearest rotation."""

from __future__ import annotations

import numpy as np
from pliant.solver.records import Floats

SMALL_ANGLE = 1e-4
"""Angle, rad, below which the closed forms suffer cancellation; their Taylor series to second order is exact to 1e-17."""

MIRROR = np.diag([1.0, 1.0, -1.0])
"""The depth mirror D: (S, R) and (S·D, D·R·D) have the same orthographic image."""


def hat(vectors: Floats) -> Floats:
    """Return the skew matrices [v]×, so that [v]× u = v × u; shapes `(..., 3)` to `(..., 3, 3)`."""
    matrices = np.zeros((*vectors.shape, 3))
    matrices[..., 0, 1], matrices[..., 0, 2], matrices[..., 1, 2] = -vectors[..., 2], vectors[..., 1], -vectors[..., 0]
    return matrices - np.swapaxes(matrices, -1, -2)


def vee(matrices: Floats) -> Floats:
    """Return u with ⟨X, [v]×⟩ = uᵀv for every v: the gradient with respect to v of a function whose gradient is X."""
    flipped = matrices - np.swapaxes(matrices, -1, -2)
    return flipped[..., [2, 0, 1], [1, 2, 0]]


def _coefficients(vectors: Floats) -> tuple[Floats, Floats, Floats]:
    """Return sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³ of the angles, shape `(..., 1, 1)` each."""
    angle = np.sqrt((vectors * vectors).sum(axis=-1))[..., None, None]
    small = angle < SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    square = angle**2
    first = np.where(small, 1 - square / 6, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24, (1 - np.cos(safe)) / safe**2)
    third = np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
    return first, second, third


def exponential(vectors: Floats) -> Floats:
    """Return the rotations by angle ‖v‖ about v (Rodrigues), shapes `(..., 3)` to `(..., 3, 3)`."""
    first, second, _ = _coefficients(vectors)
    skew = hat(vectors)
    return np.eye(3) + first * skew + second * (skew @ skew)


def logarithm(rotations: Floats) -> Floats:
    """Return the rotation vectors v, ‖v‖ ≤ π, whose exponentials are the rotations, shapes `(..., 3, 3)` to `(..., 3)`."""
    sine = 0.5 * vee(rotations)
    length = np.linalg.norm(sine, axis=-1)
    angle = np.arctan2(length, 0.5 * (np.trace(rotations, axis1=-2, axis2=-1) - 1.0))
    axis = sine / np.maximum(length, np.finfo(float).tiny)[..., None]
    # near half a turn the sine vanishes: the axis is the leading eigenvector of R + Rᵀ, with the sign of the sine vector
    opposite = angle > np.pi - 1e-3
    if np.any(opposite):
        leading = np.linalg.eigh(rotations[opposite] + np.swapaxes(rotations[opposite], -1, -2))[1][..., -1]
        sign = np.where((leading * sine[opposite]).sum(axis=-1) < 0, -1.0, 1.0)
        axis[opposite] = leading * sign[..., None]
    return np.asarray(axis * angle[..., None])


def exponential_and_jacobian(vectors: Floats) -> tuple[Floats, Floats]:
    """Return exp(v) and its left Jacobian J, exp(v + dv) = exp(J dv) exp(v) to first order, shapes `(..., 3, 3)`."""
    first, second, third = _coefficients(vectors)
    skew, identity = hat(vectors), np.eye(3)
    square = skew @ skew
    return identity + first * skew + second * square, identity + second * skew + third * square


def from_rows(rows: Floats) -> Floats:
    """Return the rotations whose first two rows are nearest to the given ones, up to a scale each.

    Parameters
    ----------
    rows : shape (..., 2, 3)
        Need not be orthonormal; the nearest orthonormal pair in the Frobenius norm is taken (polar factor).

    Returns
    -------
    shape (..., 3, 3)
    """
    left, _, right = np.linalg.svd(rows, full_matrices=False)
    pair = left @ right
    return np.concatenate([pair, np.cross(pair[..., 0, :], pair[..., 1, :])[..., None, :]], axis=-2)


def nearest(matrices: Floats) -> Floats:
    """Return the rotations nearest to the given 3×3 matrices in the Frobenius norm (determinant +1)."""
    left, _, right = np.linalg.svd(matrices)
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


def angles_between(first: Floats, second: Floats) -> Floats:
    """Return the angles in radians between rotations, shape `(...)`; accurate near zero."""
    chord = np.linalg.norm(first - second, axis=(-2, -1)) / np.sqrt(8.0)
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))


def start_at_identity(rotations: Floats) -> Floats:
    """Return the rotations in the world of the first frame's camera: R_f R_0ᵀ."""
    return np.asarray(rotations @ rotations[0].T)

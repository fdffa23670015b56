"""Mathematics of SO(3), for stacks of rotations: exponential map, its Jacobian, logarithm, nearest rotation, rotations of shapes."""

from __future__ import annotations

import numpy as np
from pliant.solver.records import Floats

HAT = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0.0]])
"""[v]× of the unit vectors v, in rows: a product with them takes a third of the time of indexing, which matters for short films."""

IDENTITY = np.eye(3)
TINY = float(np.finfo(np.float64).tiny)

ALTERNATIONS = 5
"""Alternations between mean shape and rotations, each starting from the last; the third already changes angles by less than 1e-3."""

MIRROR = np.diag([1.0, 1.0, -1.0])
"""The depth mirror D: (S, R) and (S·D, D·R·D) have the same orthographic image."""


def hat(vectors: Floats) -> Floats:
    """Return the skew matrices [v]×, so that [v]× u = v × u; shapes `(..., 3)` to `(..., 3, 3)`."""
    return np.asarray((vectors @ HAT).reshape(*vectors.shape, 3))


def vee(matrices: Floats) -> Floats:
    """Return u with ⟨X, [v]×⟩ = uᵀv for every v: the gradient with respect to v of a function whose gradient is X."""
    return np.asarray(matrices.reshape(*matrices.shape[:-2], 9) @ HAT.T)


def exponential(vectors: Floats) -> Floats:
    """Return the rotations by angle ‖v‖ about v (Rodrigues), shapes `(..., 3)` to `(..., 3, 3)`."""
    return exponential_and_jacobian(vectors)[0]


def logarithm(rotations: Floats) -> Floats:
    """Return the rotation vectors v, ‖v‖ ≤ π, whose exponentials are the rotations, shapes `(..., 3, 3)` to `(..., 3)`."""
    sine = 0.5 * vee(rotations)
    length = np.linalg.norm(sine, axis=-1)
    angle = np.arctan2(length, 0.5 * (np.trace(rotations, axis1=-2, axis2=-1) - 1.0))
    axis = sine / np.maximum(length, TINY)[..., None]
    # near half a turn the sine vanishes: the axis is the leading eigenvector of R + Rᵀ, with the sign of the sine vector
    opposite = angle > np.pi - 1e-3
    if np.any(opposite):
        leading = np.linalg.eigh(rotations[opposite] + np.swapaxes(rotations[opposite], -1, -2))[1][..., -1]
        sign = np.where((leading * sine[opposite]).sum(axis=-1) < 0, -1.0, 1.0)
        axis[opposite] = leading * sign[..., None]
    return np.asarray(axis * angle[..., None])


def exponential_and_jacobian(vectors: Floats) -> tuple[Floats, Floats]:
    """Return exp(v) and its left Jacobian J, exp(v + dv) = exp(J dv) exp(v) to first order, shapes `(..., 3, 3)`.

    J = I + (1 − cos θ)/θ² [v]× + (θ − sin θ)/θ³ [v]×², by half angles so that small ones do not cancel, and exp(v) = I + [v]× J.
    """
    square = np.maximum((vectors * vectors).sum(axis=-1), TINY)[..., None, None]
    half = 0.5 * np.sqrt(square)
    sinc = np.sin(half) / half
    skew = hat(vectors)
    # For small angles the last factor has an error of rounding/θ², and multiplies [v]×², of size θ².
    jacobian = IDENTITY + (0.5 * sinc * sinc) * skew + ((1 - sinc * np.cos(half)) / square) * (skew @ skew)
    return IDENTITY + skew @ jacobian, jacobian


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


def rotations_of(centred: Floats) -> Floats:
    """Return rotations R_f, camera from world, that align each S_f R_f with the mean shape; the first is the identity.

    Generalised Procrustes analysis (Gower 1975), from the shape nearest to the mean.

    Parameters
    ----------
    centred : shape (F, P, 3)
        Shapes S_f in camera axes, centred on the origin.

    Returns
    -------
    shape (F, 3, 3)
    """
    mean = centred[int(np.square(centred - centred.mean(axis=0)).sum(axis=(1, 2)).argmin())]
    rotations = np.tile(np.eye(3), (len(centred), 1, 1))
    for _ in range(ALTERNATIONS):
        rotations = nearest(centred.transpose(0, 2, 1) @ mean)
        mean = (centred @ rotations).mean(axis=0)
    return np.asarray(rotations @ rotations[0].T)

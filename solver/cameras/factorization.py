"""Rotations from the Gram matrix of the tracks, by prior-free factorization.

A rank-3K factorization W ≈ Π B with Π (2F×3K) is unique up to an invertible matrix. Three columns G (3K×3) of that
matrix determine the cameras: Π_f G = c_f R_f, two rows of a rotation times a coefficient. With Q = G Gᵀ therefore

    π_f1ᵀ Q π_f1 = π_f2ᵀ Q π_f2,    π_f1ᵀ Q π_f2 = 0        for every frame f,

which is linear in Q. For K > 1 many Q satisfy these equations; the positive semidefinite one of least trace has rank 3
in practice (Dai, Li, He, "A simple prior-free method for non-rigid structure-from-motion factorization", 2012). K = 1
is the metric upgrade of Tomasi and Kanade. The factor G is then refined on the constraints, which are nonlinear in G.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.limits import MAX_UNORDERED_FRAMES
from pliant.solver.model.lbfgs import minimize
from pliant.solver.model.so3 import from_rows, start_at_identity
from pliant.solver.pulse import never, pulse
from pliant.solver.records import Floats

Upper = tuple[NDArray[np.intp], NDArray[np.intp]]

TRACE_WEIGHT = 1e-3
"""μ of ½‖A(Q) − b‖²/F + μ tr Q, dimensionless; small, because the constraints take precedence over the trace."""

TRACE_ITERATIONS = 300
"""Iterations of the alternating direction method (ADMM); the refinement of G makes further ones unnecessary."""

DENSE_ROWS = 2 * MAX_UNORDERED_FRAMES
"""Maximum number of rows of a Gram matrix that is decomposed completely, in a time cubic in its rows. Only films with a prior that is not
learned have more: 3,000 frames took minutes."""

EXTRA_COLUMNS, ITERATIONS = 20, 8
"""Columns beyond the required ones, and steps, of the orthogonal iteration that finds the leading eigenvectors of larger matrices. A face
in 1,000 frames with noise of .001 of its size: those of the camera are exact to rounding, later ones above the noise to 1e-4."""

SOFTENING = 0.05
"""ε of the scale-free residual: bounds the influence of frames whose coefficient c_f passes through zero."""


@dataclass(frozen=True, slots=True, eq=False)
class Upgrade:
    """Cameras from a factorization with one K."""

    basis_size: int
    """K."""

    rotations: Floats
    """Shape `(F, 3, 3)`; the first is the identity."""


def upgrade(gram: Floats, basis_size: int) -> Upgrade:
    """Return the cameras of a rank-3K factorization of the tracks.

    Parameters
    ----------
    gram : shape (2F, 2F)
        W Wᵀ of centred, complete tracks.
    basis_size : int
        K, with 3K ≤ 2F.
    """
    return next(upgrades(gram, (basis_size,)))


def upgrades(gram: Floats, basis_sizes: Iterable[int]) -> Iterator[Upgrade]:
    """Yield the cameras of `upgrade` for every K, if there are any, from one eigendecomposition."""
    sizes = tuple(basis_sizes)
    values, vectors = leading_eigenpairs(gram, 3 * max(sizes, default=0))
    for basis_size in sizes:
        yield _upgraded(_leading(values, vectors, 3 * basis_size), basis_size)


def leading_eigenpairs(gram: Floats, count: int) -> tuple[Floats, Floats]:
    """Return the largest eigenvalues, in decreasing order, and their eigenvectors, shape `(2F, count)`, of a Gram matrix `(2F, 2F)`.

    There are at most 2F of them. Up to `DENSE_ROWS` rows the matrix is decomposed completely; beyond, by orthogonal iteration (Golub and
    Van Loan, Matrix Computations, section 8.2) with a Rayleigh-Ritz step, in a time quadratic in the rows.
    """
    if len(gram) <= DENSE_ROWS:
        values, vectors = np.linalg.eigh(gram)
        return values[::-1][:count], vectors[:, ::-1][:, :count]
    basis = np.random.default_rng(0).normal(size=(len(gram), min(count + EXTRA_COLUMNS, len(gram))))
    for _ in range(ITERATIONS):
        pulse()
        basis = np.linalg.qr(gram @ basis)[0]
    values, turn = np.linalg.eigh(basis.T @ gram @ basis)
    return values[::-1][:count], (basis @ turn)[:, ::-1][:, :count]


def _upgraded(factor: Floats, basis_size: int) -> Upgrade:
    if basis_size == 1:  # Q is unique: columns of equal length keep the trace term from shrinking a small rotation
        factor = factor / np.maximum(np.sqrt((factor**2).mean(axis=(0, 1))), 1e-6)
    corrective = refine_factor(factor, least_trace_factor(factor, 0.0 if basis_size == 1 else TRACE_WEIGHT))
    return Upgrade(basis_size, start_at_identity(from_rows(continue_signs(factor @ corrective))))


def leading_factor(gram: Floats, rank: int) -> Floats:
    """Return Π with Π Πᵀ ≈ gram and rank at most `rank`, shape `(F, 2, rank)`, RMS row length 1."""
    return _leading(*leading_eigenpairs(gram, rank), rank)


def _leading(values: Floats, vectors: Floats, rank: int) -> Floats:
    size = len(vectors)
    rank = min(rank, size)
    positive = np.maximum(values[:rank], 1e-14 * max(float(values[0]), np.finfo(float).tiny))
    factor = (vectors[:, :rank] * np.sqrt(positive)).reshape(size // 2, 2, rank)
    return np.asarray(factor / np.sqrt((factor**2).sum() / size))


def least_trace_factor(factor: Floats, trace_weight: float = TRACE_WEIGHT) -> Floats:
    """Return G (n×3) with G Gᵀ ≈ Q, the Q ⪰ 0 of least trace that satisfies the orthonormality constraints, by ADMM.

    Minimises ½‖A(Q) − b‖²/F + μ tr Q over symmetric Q ⪰ 0. The quadratic step solves for the n(n+1)/2 coordinates of Q
    with a matrix inverted once; the other step shrinks eigenvalues. The last row of A fixes the mean of c_f² at 1.
    """
    size = factor.shape[2]
    rows, columns = np.triu_indices(size)
    upper = (rows.astype(np.intp), columns.astype(np.intp))
    stretch = np.where(upper[0] == upper[1], 1.0, np.sqrt(2.0))
    normal, right = _normal_equations(factor, upper, stretch)
    penalty = 0.3 * float(np.trace(normal)) / len(normal)
    inverse = np.linalg.inv(normal + penalty * np.eye(len(normal)))
    copy = np.zeros(len(normal))
    dual = np.zeros(len(normal))
    for _ in range(TRACE_ITERATIONS):
        solved = inverse @ (right + penalty * (copy - dual))
        values, vectors = np.linalg.eigh(_unfold(solved + dual, upper, stretch, size))
        values = np.maximum(values - trace_weight / penalty, 0.0)
        copy = ((vectors * values) @ vectors.T)[upper] * stretch
        dual += solved - copy
    values, vectors = np.linalg.eigh(_unfold(copy, upper, stretch, size))
    return np.asarray(vectors[:, -3:] * np.sqrt(np.maximum(values[-3:], 1e-4 * max(float(values[-1]), 1e-9))))


def _normal_equations(factor: Floats, upper: Upper, stretch: Floats) -> tuple[Floats, Floats]:
    """Return AᵀA/F and Aᵀb/F in the coordinates where ⟨Q, Q'⟩ is the plain inner product of upper triangles."""
    first, second = factor[:, 0], factor[:, 1]
    i, j = upper

    def outer(a: Floats, b: Floats) -> Floats:
        return (a[:, i] * b[:, j] + a[:, j] * b[:, i]) * (stretch / 2)

    along, across = outer(first, first), outer(second, second)
    rows = np.concatenate([along - across, 2 * outer(first, second)])
    mean = (along + across).mean(axis=0) / 2
    frames = len(factor)
    gauge = 25.0  # weight at which the mean of c_f² is 1 to a fraction of a percent
    return rows.T @ rows / frames + gauge * np.outer(mean, mean), gauge * mean


def _unfold(coordinates: Floats, upper: Upper, stretch: Floats, size: int) -> Floats:
    matrix = np.zeros((size, size))
    matrix[upper] = coordinates / stretch
    return np.asarray(matrix + np.triu(matrix, 1).T)


def refine_factor(factor: Floats, start: Floats) -> Floats:
    """Return the G that minimises the scale-free deviation from orthonormality, by L-BFGS from `start`."""
    flat, _ = minimize(
        lambda flat: _orthonormality(flat, factor), start.ravel(), maxiter=500, maxcor=10, should_stop=never
    )
    return flat.reshape(start.shape)


def _orthonormality(flat: Floats, factor: Floats) -> tuple[float, Floats]:
    """Return mean_f ((a−b)² + 4c²) / ((a+b)² + ε m²) and its gradient in G.

    a, b, c are the entries of the 2×2 Gram matrix of Π_f G, and m is the mean of a + b. The value is invariant to the
    scale of G.
    """
    pulse()
    corrective = flat.reshape(-1, 3)
    rows = factor @ corrective
    a, b = (rows[:, 0] ** 2).sum(axis=1), (rows[:, 1] ** 2).sum(axis=1)
    c = (rows[:, 0] * rows[:, 1]).sum(axis=1)
    total, count = a + b, len(rows)
    mean = total.mean()
    departure = (a - b) ** 2 + 4 * c**2
    size = total**2 + SOFTENING * mean**2
    by_size = -departure / size**2
    by_total = 2 * total * by_size + 2 * SOFTENING * mean * by_size.sum() / count
    slope = 2 * (a - b) / size
    by_rows = np.stack(
        [
            2 * (slope + by_total)[:, None] * rows[:, 0] + (8 * c / size)[:, None] * rows[:, 1],
            2 * (by_total - slope)[:, None] * rows[:, 1] + (8 * c / size)[:, None] * rows[:, 0],
        ],
        axis=1,
    )
    gradient = np.einsum("fri,frj->ij", factor, by_rows) / count
    return float((departure / size).mean()), gradient.ravel()


def continue_signs(rows: Floats) -> Floats:
    """Return the rows with each frame's sign chosen for the smallest rotation from the previous frame.

    c_f R_f and (−c_f)(−R_f) have the same rows, so a factorization leaves one sign per frame undetermined. The wrong
    sign is a rotation by 180° about the viewing direction.
    """
    agree = np.sign((rows[1:] * rows[:-1]).sum(axis=(1, 2)))
    agree[agree == 0] = 1.0
    return np.asarray(rows * np.concatenate([[1.0], np.cumprod(agree)])[:, None, None])

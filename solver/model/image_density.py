"""The Gaussian density of a point's images over all frames, with its 3-D positions integrated out.

The image positions of one point, w ∈ R^{2F}, are N(0, V) with

    V = σ² I + Q Qᵀ + τ B (T ⊗ I₃) Bᵀ,

Q (2F×q) the images of a few columns (mean position, modes), B = blockdiag(B_f) those of a random walk (`model.random_walk`). With the Gram
matrix G = W Wᵀ / P of all points the negative log-likelihood of one point and frame is E = (log det V + tr V⁻¹G) / 2F, up to a constant,
and all derivatives for cameras, modes and variances follow from Δ = ∂E/∂V = (V⁻¹ − V⁻¹GV⁻¹)/2F:

    ∂E/∂Q = 2ΔQ,    ∂E/∂B_f = 2τ [Δ B (T ⊗ I₃)]_ff,    ∂E/∂σ² = tr Δ,    ∂E/∂τ = tr Δ B (T ⊗ I₃) Bᵀ.

Two forms agree to rounding. `dense_terms` factors V: (2F)³. `woodbury_terms` never forms a 2F×2F matrix: with D = V − QQᵀ, linear in F,
C = I + QᵀD⁻¹Q and any F₀ with G = F₀F₀ᵀ, M = C⁻¹QᵀD⁻¹F₀ is what the columns explain, Y = D⁻¹(F₀ − QM) = V⁻¹F₀, and

    tr V⁻¹G = tr (F₀ − QM)ᵀY + ‖M‖²,    V⁻¹Q = D⁻¹Q C⁻¹,    QᵀY = M:

residuals instead of differences of large numbers, so that a small σ costs no digits. `terms` selects the faster form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import inf, isfinite

import numpy as np
from pliant.solver.model.random_walk import WalkPosterior, random_walk
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats, read_only
from scipy import linalg
from scipy.linalg import lapack

DENSE_ROWS = 210
"""Maximum 2F for which V is always factored: the other form is not faster there."""

DENSE_SHARE = 0.55
"""Ratio of q plus the columns of F₀ to 2F above which factoring V is faster: measured for 2F = 240 … 714."""

MIN_DENSE_RANK = 2.0
"""Pivots of G up to this multiple of the rounding error of its largest entry count as 0."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageModel:
    """V in factored form."""

    columns: Floats
    """Q, shape `(2F, q)`."""

    walk: Floats
    """B_f, shape `(F, 2, 3)`."""

    noise_variance: float
    """σ²."""

    walk_variance: float
    """τ."""

    ordered: bool = True
    """Whether T is a random walk over frames; otherwise it is the identity."""

    def covariance(self) -> Floats:
        """Return V, shape `(2F, 2F)`."""
        rows = self.walk.reshape(-1, 3)
        image: Floats = self.columns @ self.columns.T
        image += (rows @ rows.T) * (self.walk_variance * _wide_walk(len(self.walk), self.ordered))
        image.ravel()[:: len(rows) + 1] += self.noise_variance
        return image


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """E and its derivatives."""

    value: float
    by_columns: Floats
    """∂E/∂Q, shape `(2F, q)`."""

    by_walk: Floats
    """∂E/∂B_f, shape `(F, 2, 3)`."""

    by_noise_variance: float
    """∂E/∂σ²."""

    by_walk_variance: float
    """∂E/∂τ."""

    inverse: Floats | None = None
    """V⁻¹, shape `(2F, 2F)`, where it was needed."""


def factor_of(gram: Floats) -> Floats:
    """Return F₀ with F₀F₀ᵀ = G to rounding and rank(G) columns: a pivoted Cholesky factor."""
    size, largest = len(gram), float(np.diag(gram).max(initial=0.0))
    factor, pivots, rank, _ = lapack.dpstrf(
        gram, lower=1, tol=MIN_DENSE_RANK * float(np.finfo(np.float64).eps) * largest
    )
    root = np.zeros((size, rank))
    root[pivots - 1] = np.tril(factor)[:, :rank]
    return root


def terms(model: ImageModel, factor: Floats) -> Terms:
    """Return E and its derivatives for G = F₀F₀ᵀ, F₀ of shape `(2F, r)`, in the faster form.

    Raises
    ------
    numpy.linalg.LinAlgError
        V is not positive definite to rounding, or not finite.
    """
    rows, count = model.columns.shape
    dense = rows <= DENSE_ROWS or count + factor.shape[1] > DENSE_SHARE * rows
    found = dense_terms(model, factor) if dense else woodbury_terms(model, factor)
    if not isfinite(found.value):
        raise np.linalg.LinAlgError("the density of the images is not finite")
    return found


def dense_terms(model: ImageModel, factor: Floats) -> Terms:
    """Return E and its derivatives by a Cholesky factor of V."""
    frames, rows = len(model.walk), model.walk.reshape(-1, 3)
    inverse, log_det = inverted(model.covariance())
    explained = inverse @ factor
    slope = inverse - explained @ explained.T
    slope /= frames  # 2Δ
    by_walk = model.walk_variance * ((slope * _wide_walk(frames, model.ordered)) @ rows)
    return Terms(
        0.5 * (log_det + float(np.vdot(explained, factor))) / frames, slope @ model.columns,
        by_walk.reshape(frames, 2, 3), 0.5 * float(slope.trace()), 0.5 * float(np.vdot(by_walk, rows)) / model.walk_variance,
        inverse,
    )  # fmt: skip


def woodbury_terms(model: ImageModel, factor: Floats) -> Terms:
    """Return E and its derivatives by Woodbury's identity, in time linear in the frames."""
    return Explained.of(model, factor).terms()


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """Tracks F₀, explained by the columns and the walk."""

    model: ImageModel
    walk: WalkPosterior

    solved: Floats
    """D⁻¹Q, shape `(2F, q)`."""

    walked: Floats
    """Λ⁻¹BᵀQ/σ², shape `(F, 3, q)`."""

    root: Floats
    """Lower triangular root of C, shape `(q, q)`."""

    means: Floats
    """M, shape `(q, r)`."""

    left: Floats
    """Y = V⁻¹F₀, shape `(2F, r)`."""

    strayed: Floats
    """Posterior mean of the walk given F₀, shape `(F, 3, r)`."""

    value: float
    """E."""

    @classmethod
    def of(cls, model: ImageModel, factor: Floats) -> Explained:
        """Solve for G = F₀F₀ᵀ, F₀ of shape `(2F, r)`.

        Raises
        ------
        numpy.linalg.LinAlgError
            V is not positive definite to rounding, or not finite.
        """
        pulse()
        frames, noise, columns = len(model.walk), model.noise_variance, model.columns
        walk = WalkPosterior.of(
            model.walk, noise_variance=noise, walk_variance=model.walk_variance, ordered=model.ordered
        )
        solved, walked = _solved(walk, model, columns)
        root = np.asarray(np.linalg.cholesky(np.eye(columns.shape[1]) + columns.T @ solved), dtype=np.float64)
        means = linalg.cho_solve((root, True), solved.T @ factor, check_finite=False)
        rest = factor - columns @ means
        left, strayed = _solved(walk, model, rest)
        slip = linalg.cho_solve((root, True), columns.T @ left - means, check_finite=False)  # rounding error of M
        means, rest = means + slip, rest - columns @ slip
        left, strayed = left - solved @ slip, strayed - walked @ slip
        log_det = 2 * frames * float(np.log(noise)) + walk.log_det + 2 * float(np.log(np.diag(root)).sum())
        trace = float(np.einsum("ij,ij->", rest, left)) + float((means**2).sum())
        return cls(model, walk, solved, walked, root, means, left, strayed, 0.5 * (log_det + trace) / frames)

    def terms(self) -> Terms:
        """Return E and its derivatives."""
        model, frames, noise = self.model, len(self.model.walk), self.model.noise_variance
        inner = linalg.cho_solve((self.root, True), self.solved.T, check_finite=False).T  # V⁻¹Q
        seen = model.walk @ self.walk.variances / noise
        by_walk = seen - inner.reshape(frames, 2, -1) @ self.walked.transpose(0, 2, 1)
        by_walk -= self.left.reshape(frames, 2, -1) @ self.strayed.transpose(0, 2, 1)
        by_walk /= frames
        inverse_trace = (2 * frames - float((seen * model.walk).sum())) / noise - float((inner * self.solved).sum())
        return Terms(
            self.value,
            (inner - self.left @ self.means.T) / frames,
            by_walk,
            0.5 * (inverse_trace - float((self.left**2).sum())) / frames,
            0.5 * float((by_walk * model.walk).sum()) / model.walk_variance,
        )

    def surplus(self, columns: Floats) -> Floats:
        """Return V⁻¹(G − V)V⁻¹ times columns of shape `(2F, c)`."""
        means = linalg.cho_solve((self.root, True), self.solved.T @ columns, check_finite=False)
        inverse, _ = _solved(self.walk, self.model, columns - self.model.columns @ means)
        result: Floats = self.left @ (self.left.T @ columns)
        result -= inverse
        return result


def negative_log_likelihoods(model: ImageModel, tracks: Floats) -> Floats:
    """Return −log of the density of each column of tracks `(2F, P)`, per frame, up to a constant, shape `(P,)`."""
    rows, frames = len(tracks), len(model.walk)
    if rows <= DENSE_ROWS:
        factor = linalg.cho_factor(model.covariance(), lower=True)
        log_det = 2 * float(np.log(np.diag(factor[0])).sum())
        squares = (tracks * linalg.cho_solve(factor, tracks)).sum(axis=0)
    else:
        found = Explained.of(model, tracks)
        squares = ((tracks - model.columns @ found.means) * found.left).sum(axis=0) + (found.means**2).sum(axis=0)
        log_det = 2 * frames * found.value - float(squares.sum())
    return np.asarray(0.5 * (log_det + squares) / frames)


def inverted(matrix: Floats) -> tuple[Floats, float]:
    """Return inverse and log-determinant of a positive definite matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        It is indefinite to rounding, or not finite.
    """
    pulse()
    factor, failed = lapack.dpotrf(matrix, lower=1)
    log_det = inf if failed else 2 * float(np.log(factor.diagonal()).sum())
    if not isfinite(log_det):
        raise np.linalg.LinAlgError("the covariance of the images is not positive definite")
    inverse = np.asarray(lapack.dpotri(factor, lower=1, overwrite_c=1)[0])
    inverse.ravel("K")[:: len(inverse) + 1] *= 0.5  # above the diagonal, the factor has zeros
    return inverse + inverse.T, log_det


def _solved(walk: WalkPosterior, model: ImageModel, columns: Floats) -> tuple[Floats, Floats]:
    """Return D⁻¹ times columns `(2F, r)`, and Λ⁻¹Bᵀ/σ² times them, shape `(F, 3, r)`."""
    frames, noise = len(model.walk), model.noise_variance
    split = columns.reshape(frames, 2, -1)
    means = walk.solve(model.walk.transpose(0, 2, 1) @ split)
    means /= noise
    rest = split - model.walk @ means
    rest /= noise
    return rest.reshape(columns.shape), means


@lru_cache(maxsize=8)
def _wide_walk(frames: int, ordered: bool) -> Floats:
    """Return T over image coordinates, shape `(2F, 2F)`, read-only."""
    wide = np.repeat(np.repeat(random_walk(frames, ordered), 2, axis=0), 2, axis=1)
    read_only(wide)
    return wide

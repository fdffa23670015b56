"""Complete, clean tracks out of hidden and wrong ones: a robust low-rank factor with missing entries.

The cameras are computed from the Gram matrix W Wᵀ, which one gross outlier spoils and which hidden entries leave undefined.
Tracks of a moving thing are nearly of low rank, so W ≈ M B + t 1ᵀ is fitted to the entries that were seen, by alternating
least squares whose weights fall with the residual and whose coefficients B have a Gaussian prior, its covariance fitted too.
The basis M (2F×r) and the translations t come from a sample of points:
the cost does not depend on P; one pass then carries every point onto the basis.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.errors import InvalidInput
from pliant.solver.records import MIN_POINTS, Floats
from pliant.solver.tracks.normalization import Normalized

SAMPLE = 600
"""Points that the basis is fitted to."""

RANKS = (4, 7, 10, 16, 25, 40)
"""Columns tried, translation included; each rank starts from the one before. Measured without the last: a dancer half of whom is hidden
.134 instead of .123; 60 gains no more."""

SWEEPS = 8
"""Alternations at each rank."""

HELD_OUT_SHARE = 0.05
"""Share of the seen entries of the sample that is hidden to choose the rank by predicting it."""

MIN_OUTLIER_RESIDUAL = 0.15
"""Normalized units below which a residual is never called an outlier, however well the others fit."""

OUTLIER_SIGMAS = 6.0
"""Residuals beyond this many robust standard deviations are outliers."""

CHUNK = 4096
"""Points carried onto the basis at once; bounds the memory at CHUNK·(6F + r²) numbers."""

MIN_RESIDUAL_SCALE = 0.01
"""Normalized units: smallest residual scale of the weights, so that clean tracks are fitted by plain least squares, and of the
prior on coefficients: measured on turning bodies, of which no point is always seen, a finer one extrapolates, a coarser one blurs."""

DAMPING = 1e-2
"""The same, before the spread of the coefficients is known."""

RIDGE = 1e-6
"""Regularises coefficients of points that were seen too seldom."""


@dataclass(frozen=True, slots=True, eq=False)
class Filling:
    """The low-rank factor that fills holes."""

    basis: Floats
    """Shape `(F, 2, r)`, last column the translation."""

    spread: Floats
    """Covariance of the coefficients, shape `(r − 1, r − 1)`."""

    scale: float
    """Standard deviation of the residuals, normalized units."""


@dataclass(frozen=True, slots=True, eq=False)
class Completed:
    """Tracks with every entry filled, centred per frame."""

    gram: Floats
    """W Wᵀ / P over all points, shape `(2F, 2F)`."""

    sample: Floats
    """Some of the points, shape `(F, S, 2)`, normalized units."""

    translations: Floats
    """Mean of the completed points of each frame, shape `(F, 2)`: what the centroid of the visible ones missed."""

    rank: int
    """Columns of the basis that filled the holes, translation included; 0 when nothing was filled."""

    outliers: float
    """Share of the seen entries of the sample that was replaced."""

    filling: Filling | None = None
    """How hidden entries and outliers were replaced; None: nothing was."""


def complete(normalized: Normalized, *, seed: int = 0, rank: int = 0) -> Completed:
    """Fill hidden entries, replace gross outliers, and return the Gram matrix of the result.

    Parameters
    ----------
    normalized : Normalized
        Points (F, P, 2) in normalized units with their visibility.
    seed : int
        Of the sample of points and of the held-out entries.
    rank : int
        Columns of the basis as an earlier completion of these tracks chose them; 0 chooses them.

    Raises
    ------
    InvalidInput
        Hardly any point is seen in two frames.
    """
    most = float(normalized.visible.max())
    if 0 < most < 1:  # only the ratios of confidences count
        normalized = replace(normalized, visible=normalized.visible / most)
    random = np.random.default_rng(seed)
    chosen = choose_points(normalized.visible, random)
    again = seen_again(normalized.visible)
    if again < MIN_POINTS:
        raise InvalidInput(
            "too_little_seen", field="visibility", expected=f"at least {MIN_POINTS} points that are seen in two frames or more",
            got=f"{again}", hint="Check that the visibility is not inverted, and that a point keeps its place from frame to frame.",
        )  # fmt: skip
    points, weight = normalized.points[:, chosen], normalized.visible[:, chosen]
    basis, spread, scale = fit_basis(points, weight, random, rank)
    outliers = fill(points, weight, basis, spread, scale)[1]
    clean = outliers == 0.0 and bool((normalized.visible == 1).all())
    filling = None if clean else Filling(basis, spread, scale)
    gram, translations, sample = _carry(normalized, filling, chosen)
    return Completed(gram, sample, translations, 0 if clean else basis.shape[2], outliers, filling)


def seen_again(visible: Floats) -> int:
    """Return how many points are seen in two frames or more."""
    return int(((visible > 0).sum(axis=0) >= 2).sum())


def choose_points(visible: Floats, random: np.random.Generator) -> NDArray[np.intp]:
    """Return the sorted indices of at most `SAMPLE` points, preferring those seen more often than the median."""
    seen = (visible > 0).sum(axis=0)
    usable = np.flatnonzero(seen >= min(2, int(seen.max())))
    if len(usable) <= SAMPLE:
        return usable
    often = usable[seen[usable] >= np.median(seen[usable])]
    half = random.choice(often, min(SAMPLE // 2, len(often)), replace=False)
    rest = random.choice(np.setdiff1d(usable, half), SAMPLE - len(half), replace=False)
    return np.sort(np.concatenate([half, rest]))


def fit_basis(
    points: Floats, weight: Floats, random: np.random.Generator, given: int = 0
) -> tuple[Floats, Floats, float]:
    """Return the basis (F, 2, r), last column the translation, the spread of its coefficients, and that of the residuals.

    The rank is the one that is given, or that predicts held-out entries best; a larger one must do so by more than 2 %.
    """
    frames, count = weight.shape
    held = (random.random(weight.shape) < HELD_OUT_SHARE) & (weight > 0)
    kept = np.where(held, 0.0, weight)
    start = _interpolated(points, weight)
    hidden = bool((weight == 0).any())
    best_error, best_rank, basis = np.inf, RANKS[0], np.zeros((frames, 2, 0))
    for rank in RANKS:
        if rank > min(2 * frames, count) - 1 or rank * (2 * frames + count) > 0.7 * 2 * (kept > 0).sum():
            break
        basis = _widen(basis, points, kept, start, rank)
        basis, coefficients, spread, scale = alternate(points, kept, basis, sweeps=SWEEPS)
        if not hidden and not gross(points, weight, predict(basis, coefficients), scale).any():
            return basis, spread, scale
        error = _typical(_lengths(points - predict(basis, coefficients)), held & (weight > 0))
        if error < 0.98 * best_error or rank <= given:
            best_error, best_rank, best = error, rank, basis
        elif rank > 2 * best_rank:
            break
        if rank == given:
            break
    if not np.isfinite(best_error):
        best = _widen(np.zeros((frames, 2, 0)), points, weight, start, min(3, min(2 * frames, count) - 1))
    basis, _, spread, scale = alternate(points, weight, best, sweeps=2 * SWEEPS)
    return basis, spread, scale


def alternate(points: Floats, weight: Floats, basis: Floats, *, sweeps: int) -> tuple[Floats, Floats, Floats, float]:
    """Return basis, coefficients (S, r−1), their spread and the residual scale after `sweeps` robust alternations.

    Weights are those of the Cauchy loss, whose scale follows three times the median residual.
    """
    coefficients, spread = coefficients_of(points, weight, basis, None, 1.0, sweeps=3)
    scale = MIN_RESIDUAL_SCALE
    for _ in range(sweeps):
        lengths = _lengths(points - predict(basis, coefficients))
        scale = max(_typical(lengths, weight > 0), MIN_RESIDUAL_SCALE)
        robust = weight / (1 + (lengths / (3 * scale)) ** 2)
        extended = np.concatenate([coefficients, np.ones((len(coefficients), 1))], axis=1)
        normal = np.einsum("fp,pi,pj->fij", robust, extended, extended, optimize=True)
        normal += _ridge(normal)
        right = np.einsum("fp,fpc,pi->fic", robust, points, extended, optimize=True)
        basis = np.linalg.solve(normal, right).transpose(0, 2, 1)
        basis, change = _orthonormal(basis)
        coefficients, spread = coefficients_of(points, robust, basis, change @ spread @ change.T, scale, sweeps=1)
    return basis, coefficients, spread, scale


def coefficients_of(
    points: Floats, weight: Floats, basis: Floats, spread: Floats | None, scale: float, *, sweeps: int
) -> tuple[Floats, Floats]:
    """Return each point's coefficients on the basis, shape (S, r−1), and their spread, shape (r−1, r−1).

    Reweighted least squares with a Gaussian prior: a point that was seen in few frames shows few of its coefficients, and least
    squares alone sends the others, and with them the hidden positions, anywhere. The spread is the points' second moment,
    posterior variance included (one EM step); without one, a first spread comes from strongly damped least squares.
    """
    columns, shift = basis[:, :, :-1], basis[:, :, -1]
    products = np.einsum("fci,fcj->fij", columns, columns).reshape(len(basis), -1)
    robust, size = weight, columns.shape[2]
    coefficients, moment = np.zeros((points.shape[1], size)), np.eye(size)
    for sweep in range(sweeps):
        normal = (robust.T @ products).reshape(-1, size, size)
        normal += _ridge(normal, DAMPING) if spread is None else _prior(spread, scale) + _ridge(normal)
        right = np.einsum("fp,fpc,fci->pi", robust, points - shift[:, None], columns, optimize=True)
        inverse = np.linalg.inv(normal)
        coefficients = np.einsum("pij,pj->pi", inverse, right)
        moment = coefficients.T @ coefficients / len(coefficients)
        if spread is not None:
            moment = moment + scale**2 * inverse.mean(axis=0)
        if sweep + 1 < sweeps:
            lengths = _lengths(points - predict(basis, coefficients))
            typical = max(_typical(lengths, weight > 0), MIN_RESIDUAL_SCALE)
            robust = weight / (1 + (lengths / (3 * typical)) ** 2)
    return coefficients, moment


def predict(basis: Floats, coefficients: Floats) -> Floats:
    """Return M B + t as points, shape `(F, S, 2)`."""
    return np.asarray(np.einsum("fci,pi->fpc", basis[:, :, :-1], coefficients, optimize=True) + basis[:, None, :, -1])


def fill(points: Floats, weight: Floats, basis: Floats, spread: Floats, scale: float) -> tuple[Floats, float]:
    """Return points with hidden entries predicted and outliers replaced, and the share of seen entries replaced.

    An entry of confidence c in between is drawn to its prediction, c times itself and 1 − c times that: expectation maximisation's
    completion of an observation whose noise variance is 1/c times as large.
    """
    coefficients, _ = coefficients_of(points, weight, basis, spread, scale, sweeps=4)
    predicted = predict(basis, coefficients)
    wrong = gross(points, weight, predicted, scale)
    trust = np.where(wrong, 0.0, weight)[..., None]
    filled = np.where(trust == 1, points, predicted + trust * (points - predicted))
    return filled, float(wrong.sum() / max((weight > 0).sum(), 1))


def gross(points: Floats, weight: Floats, predicted: Floats, scale: float) -> NDArray[np.bool_]:
    """Return which seen entries lie too far from their prediction to be believed, shape `(F, S)`."""
    return np.asarray((weight > 0) & (_lengths(points - predicted) > max(OUTLIER_SIGMAS * scale, MIN_OUTLIER_RESIDUAL)))


def spans(normalized: Normalized, filling: Filling | None) -> Iterator[tuple[NDArray[np.intp], Floats]]:
    """Yield the points that are seen at all, completed, a chunk at a time: their indices, and positions `(F, n, 2)`."""
    count = normalized.visible.shape[1]
    for start in range(0, count, CHUNK):
        span = slice(start, min(start + CHUNK, count))
        points, weight = normalized.points[:, span], normalized.visible[:, span]
        shown = (weight > 0).any(axis=0)
        points, weight = points[:, shown], weight[:, shown]
        if filling is not None:
            points, _ = fill(points, weight, filling.basis, filling.spread, filling.scale)
        yield np.flatnonzero(shown) + span.start, points


def _carry(normalized: Normalized, filling: Filling | None, chosen: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Return Gram matrix, translations and centred sample, filling all points chunk by chunk."""
    frames = len(normalized.points)
    gram, total = np.zeros((2 * frames, 2 * frames)), np.zeros((frames, 2))
    sample = np.zeros((frames, len(chosen), 2))
    used = 0
    for places, points in spans(normalized, filling):
        stacked = points.transpose(0, 2, 1).reshape(2 * frames, -1)
        gram += stacked @ stacked.T
        total += points.sum(axis=1)
        used += points.shape[1]
        inside = np.isin(places, chosen, assume_unique=True)
        sample[:, np.isin(chosen, places, assume_unique=True)] = points[:, inside]
    mean = total / used
    flat = mean.reshape(-1)
    return gram / used - np.outer(flat, flat), mean, sample - mean[:, None]


def _interpolated(points: Floats, weight: Floats) -> Floats:
    """Return points with hidden entries interpolated in time, and far ones pulled in: only a start."""
    filled = points.copy()
    frames = np.arange(len(points))
    for index in np.flatnonzero((weight == 0).any(axis=0)):
        seen = weight[:, index] > 0
        for axis in (0, 1):
            filled[:, index, axis] = np.interp(frames, frames[seen], points[seen, index, axis]) if seen.any() else 0.0
    return np.clip(filled, -3.0, 3.0)


def _widen(basis: Floats, points: Floats, weight: Floats, start: Floats, rank: int) -> Floats:
    """Return a basis of `rank` columns: the old ones, then the leading directions of what they leave."""
    frames = len(points)
    if basis.shape[2] == 0:
        left, shift = start, start.mean(axis=1)
        old = np.zeros((frames, 2, 0))
    else:
        coefficients, _ = coefficients_of(points, weight, basis, None, 1.0, sweeps=2)
        left = points - predict(basis, coefficients)
        scale = max(_typical(_lengths(left), weight > 0), MIN_RESIDUAL_SCALE)
        left *= (weight / (1 + (_lengths(left) / (3 * scale)) ** 2))[..., None]
        old, shift = basis[:, :, :-1], basis[:, :, -1]
    stacked = (left - left.mean(axis=1, keepdims=True)).transpose(0, 2, 1).reshape(2 * frames, -1)
    vectors = _leading(stacked, rank - 1 - old.shape[2])
    new = vectors.reshape(frames, 2, -1)
    return np.concatenate([old, new, shift[..., None]], axis=2)


def _orthonormal(basis: Floats) -> tuple[Floats, Floats]:
    """Return the basis with orthonormal columns, and the matrix that takes the old coefficients to the new."""
    columns = basis[:, :, :-1]
    frames, _, rank = columns.shape
    unit, change = np.linalg.qr(columns.reshape(2 * frames, rank))
    return np.concatenate([unit.reshape(frames, 2, rank), basis[:, :, -1:]], axis=2), np.asarray(change)


def _prior(spread: Floats, scale: float) -> Floats:
    """Return σ² Σ⁻¹, Σ the spread; directions in which no point was seen to move stay nearly still."""
    size = len(spread)
    floor = 1e-8 * max(float(np.trace(spread)), 1e-12) / max(size, 1)
    return np.asarray(scale**2 * np.linalg.inv(spread + floor * np.eye(size)))


def _ridge(normal: Floats, share: float = RIDGE) -> Floats:
    size = normal.shape[-1]
    mean = float(np.trace(normal.mean(axis=0))) / size
    return np.asarray(share * max(mean, 1e-12) * np.eye(size))


def _lengths(difference: Floats) -> Floats:
    return np.asarray(np.sqrt(np.einsum("fpc,fpc->fp", difference, difference)))


def _typical(lengths: Floats, mask: NDArray[np.bool_]) -> float:
    """Return the standard deviation per coordinate of an isotropic Gaussian with this median length."""
    return float(np.median(lengths[mask]) / 1.1774) if mask.any() else 0.0


def _leading(matrix: Floats, count: int) -> Floats:
    """Return the `count` leading left singular vectors, through the Gram matrix of the shorter side."""
    rows, columns = matrix.shape
    if rows <= columns:
        return np.asarray(np.linalg.eigh(matrix @ matrix.T)[1][:, ::-1][:, :count])
    values, right = np.linalg.eigh(matrix.T @ matrix)
    values, right = values[::-1][:count], right[:, ::-1][:, :count]
    return np.asarray(np.asarray(matrix @ right) / np.sqrt(np.maximum(values, 1e-14 * max(float(values[0]), 1e-300))))

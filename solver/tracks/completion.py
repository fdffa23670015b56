"""Robust low-rank completion: fill hidden entries of the tracks and replace gross outliers.

Cameras are computed from the Gram matrix W Wᵀ, which hidden entries leave undefined and a single gross outlier can
dominate. Tracks of a moving object have approximately low rank, so W ≈ M B + t 1ᵀ is fitted to the visible entries by
alternating robust least squares, with a Gaussian prior on the coefficients B whose covariance is estimated as well.
The basis M (2F×r) and the translations t are fitted to a sample of points, so the cost of the fit does not depend on
P; all points are then projected onto the basis in one pass.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.solver.agreement import check_seen
from pliant.solver.pulse import ShouldStop, never
from pliant.solver.records import Floats
from pliant.solver.threads import SMALLEST, over_ranges
from pliant.solver.tracks.frame_selection import longest_gaps
from pliant.solver.tracks.matrix import centred, columns
from pliant.solver.tracks.noise import RAYLEIGH_MEDIAN, weighted_median
from pliant.solver.tracks.normalization import MAX_MEDIAN_RADII, Normalized

MAX_SAMPLE_POINTS = 600
"""Maximum number of points to which the basis is fitted."""

RANKS = (4, 7, 10, 16, 25, 40)
"""Numbers of basis columns that are compared, translation included; each fit starts from the previous one. On a dancer
with half of the points hidden, the error is .123 with 40 and .134 without; 60 gives no further gain."""

ALTERNATIONS_PER_RANK = 8
"""Alternations per rank."""

HELD_OUT_SHARE = 0.05
"""Share of the visible entries of the sample that is held out to select the rank."""

MIN_OUTLIER_RESIDUAL = 0.15
"""Residual, normalized units, below which an entry is never replaced as an outlier."""

MIN_REPLACED_STDS = 6.0
"""Residual, in robust standard deviations, below which an entry is never replaced as an outlier."""

POINTS_PER_CHUNK = 4096
"""Points projected onto the basis at once; bounds the memory at POINTS_PER_CHUNK·(6F + r²) numbers."""

CHUNKS_PER_TICK = 16
"""Chunks of the Gram matrix between calls of `should_stop`: about a second for 100 frames."""

MIN_RESIDUAL_SCALE = 0.01
"""Floor of the residual scale, normalized units, in the robust weights (clean tracks get plain least squares) and in the
prior on the coefficients. On rotating bodies, where no point is always visible, a lower floor extrapolates and a higher
one blurs."""

DAMPING = 1e-2
"""Ridge on the normal equations relative to their mean diagonal, before the covariance of the coefficients is known."""

COEFFICIENT_RIDGE = 1e-6
"""Ridge relative to the mean diagonal; keeps the coefficients of sparsely observed points determined."""

LONGEST_GAP = 0.1
"""Longest time for which a point may be hidden if perspective is looked for in its completed track, share of the frames. With .05, two
films of a fish and a hand have focal lengths of .94 and 1.12 of the true ones, with .1 .99 and 1.13, with half of the frames in all 2.8
and 1.19."""


@dataclass(frozen=True, slots=True, eq=False)
class Filling:
    """The low-rank factor from which hidden entries are predicted."""

    basis: Floats
    """Basis M, shape `(F, 2, r)`; the last column is the translation t."""

    spread: Floats
    """Covariance of the coefficients, shape `(r − 1, r − 1)`."""

    scale: float
    """Standard deviation of the residuals, normalized units."""

    def outliers(self, points: Floats, weight: Floats) -> NDArray[np.bool_]:
        """Return a mask of the gross outliers, shape `(F, P)`, in `points (F, P, 2)` of confidence `weight (F, P)`."""
        return self._predicted(points, weight)[1]

    def filled(self, points: Floats, weight: Floats) -> tuple[Floats, float]:
        """Replace hidden entries and outliers by predictions; also return the replaced share of the visible entries' confidence.

        In a frame that shows about as few points as the basis has columns, noise determines M and would place hidden points hundreds of
        radii away. Predictions are therefore moved towards the centroid, to a distance of at most `MAX_MEDIAN_RADII` normalized units.

        An entry with confidence 0 < c < 1 becomes c times itself plus 1 − c times its prediction: the EM completion of an
        observation whose noise variance is 1/c times as large.
        """
        predicted, wrong = self._predicted(points, weight)
        predicted *= (MAX_MEDIAN_RADII / np.maximum(_lengths(predicted), MAX_MEDIAN_RADII))[..., None]
        trust = np.where(wrong, 0.0, weight)[..., None]
        filled = np.where(trust == 1, points, predicted + trust * (points - predicted))
        return filled, float(weight[wrong].sum() / max(weight.sum(), np.finfo(float).tiny))

    def _predicted(self, points: Floats, weight: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the predictions, shape `(F, P, 2)`, and a mask of the visible gross outliers, shape `(F, P)`."""
        coefficients, _ = coefficients_of(points, weight, self.basis, self.spread, self.scale, sweeps=4)
        predicted = predict(self.basis, coefficients)
        return predicted, gross(points, weight, predicted, self.scale)


@dataclass(frozen=True, slots=True, eq=False)
class Completed:
    """Completed tracks, centred per frame."""

    gram: Floats
    """W Wᵀ / P over the often visible points, shape `(2F, 2F)`."""

    sample: Floats
    """Sampled points, shape `(F, S, 2)`, normalized units."""

    translations: Floats
    """Centroid of the often visible points, completed, minus centroid of the visible points, per frame, shape `(F, 2)`."""

    rank: int
    """Number of columns of the basis, translation included; 0 if nothing was filled."""

    outlier_share: float
    """Share of the sample's visible entries, weighted by confidence, that were replaced as outliers."""

    filling: Filling | None = None
    """The factor that replaced hidden entries and outliers; None if none were replaced."""

    sampled: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """Indices of the sampled points, shape `(S,)`."""


def complete(normalized: Normalized, *, seed: int = 0, rank: int = 0, should_stop: ShouldStop = never) -> Completed:
    """Fill hidden entries, replace gross outliers, and return the Gram matrix of the result.

    Parameters
    ----------
    normalized : Normalized
        Points (F, P, 2) in normalized units with their visibility.
    seed : int
        Seed of the sample of points and of the held-out entries.
    rank : int
        Number of basis columns, e.g. from an earlier completion of these tracks; 0 selects it.
    should_stop : callable, optional
        Called after every rank tried, and between chunks of points; once it returns True, the best rank so far is used.

    Raises
    ------
    InvalidInput
        Fewer than `MIN_POINTS` points are visible in two or more frames.
    """
    random = np.random.default_rng(seed)
    chosen = choose_points(normalized.visible, random)
    check_seen(normalized.visible)
    points, weight = normalized.points[:, chosen], normalized.visible[:, chosen]
    basis, spread, scale = fit_basis(points, weight, random, rank, should_stop=should_stop)
    found = Filling(basis, spread, scale)
    _, outliers = found.filled(points, weight)
    clean = outliers == 0.0 and bool((normalized.visible == 1).all())
    filling = None if clean else found
    gram, translations, sample = _carry(normalized, filling, chosen, should_stop)
    return Completed(gram, sample, translations, 0 if clean else basis.shape[2], outliers, filling, chosen)


def choose_points(visible: NDArray[np.floating[Any]], random: np.random.Generator) -> NDArray[np.intp]:
    """Return sorted indices of at most `MAX_SAMPLE_POINTS` points, half of them visible at least as often as the median."""
    seen = (visible > 0).sum(axis=0)
    usable = np.flatnonzero(seen >= min(2, int(seen.max())))
    if len(usable) <= MAX_SAMPLE_POINTS:
        return usable
    often = usable[seen[usable] >= np.median(seen[usable])]
    half = random.choice(often, min(MAX_SAMPLE_POINTS // 2, len(often)), replace=False)
    rest = random.choice(np.setdiff1d(usable, half), MAX_SAMPLE_POINTS - len(half), replace=False)
    return np.sort(np.concatenate([half, rest]))


def often_visible(visible: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Return a mask of the points whose completed tracks cameras and focal length are estimated from, shape `(P,)`.

    A point that an object turns out of sight is hidden over many consecutive frames, where completion extrapolates it without perspective.
    With all points of the body in `tests/solver/cameras/test_self_occlusion.py`, the focal length is 35 % too long and the error .018; with
    these points 1 % and .0031.

    A point is used if some frame shows it, and it is visible in at least half of all frames, or as often as the median point that this
    frame shows. So every frame keeps half of its points, however short the tracks are.
    """
    seen = visible > 0
    count = seen.sum(axis=0)
    often = np.zeros(len(count), dtype=bool)
    for shown in seen:
        if shown.any():
            often |= shown & (count >= min(len(seen) / 2, float(np.median(count[shown]))))
    return np.asarray(often & (count >= min(2, int(count.max()))))


def briefly_hidden(visible: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Return a mask of the points whose completed tracks perspective is looked for in, shape `(P,)`.

    Where a point is hidden for long, its completed track follows an orthographic model, which explains perspective away. A tracker loses
    the parts that move most; in a film of a fish it kept the tail in half of the frames, and the focal length was 2.8 times too long.

    A point is used if it is hidden for at most `LONGEST_GAP` of the frames at a time, or for no longer than the median point that some
    frame shows.
    """
    seen, gaps = visible > 0, longest_gaps(visible)
    used = np.zeros(len(gaps), dtype=bool)
    for shown in seen:
        if shown.any():
            used |= shown & (gaps <= max(LONGEST_GAP * len(seen), float(np.median(gaps[shown]))))
    count = seen.sum(axis=0)
    return np.asarray(used & (count >= min(2, int(count.max()))))


def ranks(points: Floats) -> NDArray[np.intp]:
    """Return each point's rank by the sum of its squared distances from the centroid, largest first, shape `(P,)`.

    Random choices by rank depend neither on the order of the points nor on the image's axes.
    """
    nearness = -(points**2).sum(axis=(0, 2))
    return np.argsort(np.argsort(nearness, kind="stable"), kind="stable")


def fit_basis(
    points: Floats, weight: Floats, random: np.random.Generator, given: int = 0, *,
    should_stop: ShouldStop,
) -> tuple[Floats, Floats, float]:  # fmt: skip
    """Return the basis (F, 2, r) with the translation last, the covariance of its coefficients, and the residual scale.

    Without a given rank, the rank with the lowest held-out error is selected; a larger rank must reduce it by 2 %.
    """
    frames, count = weight.shape
    held = (random.random(weight.shape)[:, ranks(points)] < HELD_OUT_SHARE) & (weight > 0)
    kept = np.where(held, 0.0, weight)
    start = _interpolated(points, weight)
    hidden = bool((weight == 0).any())
    best_error, best_rank, basis = np.inf, RANKS[0], np.zeros((frames, 2, 0))
    for rank in RANKS:
        if rank > min(2 * frames, count) - 1 or rank * (2 * frames + count) > 0.7 * 2 * (kept > 0).sum():
            break
        basis = _widen(basis, points, kept, start, rank)
        basis, coefficients, spread, scale = alternate(points, kept, basis, sweeps=ALTERNATIONS_PER_RANK)
        if not hidden and not gross(points, weight, predict(basis, coefficients), scale).any():
            return basis, spread, scale
        error = _typical(_lengths(points - predict(basis, coefficients)), np.where(held, weight, 0.0))
        if error < 0.98 * best_error or rank <= given:
            best_error, best_rank, best = error, rank, basis
        elif rank > 2 * best_rank:
            break
        if rank == given or should_stop():
            break
    if not np.isfinite(best_error):
        best = _widen(np.zeros((frames, 2, 0)), points, weight, start, min(3, min(2 * frames, count) - 1))
    basis, _, spread, scale = alternate(points, weight, best, sweeps=2 * ALTERNATIONS_PER_RANK)
    return basis, spread, scale


def alternate(points: Floats, weight: Floats, basis: Floats, *, sweeps: int) -> tuple[Floats, Floats, Floats, float]:
    """Return basis, coefficients (S, r−1), their covariance and the residual scale after `sweeps` robust alternations."""
    coefficients, _ = coefficients_of(points, weight, basis, None, 1.0, sweeps=3)
    spread, scale = coefficients.T @ coefficients / len(coefficients), MIN_RESIDUAL_SCALE
    for _ in range(sweeps):
        robust, scale = _reweighted(_lengths(points - predict(basis, coefficients)), weight)
        extended = np.concatenate([coefficients, np.ones((len(coefficients), 1))], axis=1)
        normal = extended.T @ (robust[..., None] * extended)
        normal += _ridge(normal)
        right = extended.T @ (robust[..., None] * points)
        basis = np.linalg.solve(normal, right).transpose(0, 2, 1)
        basis, change = _orthonormal(basis)
        coefficients, normal = coefficients_of(points, robust, basis, change @ spread @ change.T, scale, sweeps=1)
        # One EM step: the second moment over the points, posterior variance included.
        spread = coefficients.T @ coefficients / len(coefficients) + scale**2 * np.linalg.inv(normal).mean(axis=0)
    return basis, coefficients, spread, scale


def coefficients_of(
    points: Floats,
    weight: Floats,
    basis: Floats,
    spread: Floats | None,
    scale: float,
    *,
    sweeps: int,
) -> tuple[Floats, Floats]:
    """Return each point's coefficients on the basis, shape (S, r−1), and the matrices of their equations, shape (S, r−1, r−1).

    Reweighted least squares with a Gaussian prior of covariance `spread`; damped least squares if it is None. A point visible
    in few frames determines few of its coefficients; without a prior the others, and thus the hidden positions, would be
    unbounded.
    """
    columns, shift = basis[:, :, :-1], basis[:, :, -1]
    products = np.einsum("fci,fcj->fij", columns, columns).reshape(len(basis), -1)
    robust, size = weight, columns.shape[2]
    coefficients, normal = np.zeros((points.shape[1], size)), np.zeros((points.shape[1], size, size))
    for sweep in range(sweeps):
        normal = (robust.T @ products).reshape(-1, size, size)
        normal += _ridge(normal, DAMPING) if spread is None else _prior(spread, scale) + _ridge(normal)
        pulled = (robust[..., None] * (points - shift[:, None])).transpose(1, 0, 2).reshape(len(coefficients), -1)
        coefficients = _solved(normal, pulled @ columns.reshape(-1, size))
        if sweep + 1 < sweeps:
            robust, _ = _reweighted(_lengths(points - predict(basis, coefficients)), weight)
    return coefficients, normal


def _solved(normal: Floats, right: Floats) -> Floats:
    """Solve P linear systems with matrices `(P, n, n)` and right-hand sides `(P, n)`."""
    found = np.empty_like(right)

    def work(start: int, stop: int) -> None:
        found[start:stop] = np.linalg.solve(normal[start:stop], right[start:stop, :, None])[..., 0]

    over_ranges(work, len(right), smallest=max(1, SMALLEST // right.shape[1] ** 2))
    return found


def predict(basis: Floats, coefficients: Floats) -> Floats:
    """Return M B + t as points, shape `(F, S, 2)`."""
    frames, _, rank = basis.shape
    along = (basis[:, :, :-1].reshape(2 * frames, rank - 1) @ coefficients.T).reshape(frames, 2, -1)
    return np.asarray((along + basis[:, :, -1:]).transpose(0, 2, 1))


def gross(points: Floats, weight: Floats, predicted: Floats, scale: float) -> NDArray[np.bool_]:
    """Return a mask of the visible entries that are gross outliers given their prediction, shape `(F, S)`."""
    return np.asarray(
        (weight > 0) & (_lengths(points - predicted) > max(MIN_REPLACED_STDS * scale, MIN_OUTLIER_RESIDUAL))
    )


def spans(normalized: Normalized, filling: Filling | None) -> Iterator[tuple[NDArray[np.intp], Floats]]:
    """Yield the completed points in chunks, as indices `(n,)` and positions `(F, n, 2)`; skip points that are never visible."""
    count = normalized.visible.shape[1]
    for start in range(0, count, POINTS_PER_CHUNK):
        span = slice(start, min(start + POINTS_PER_CHUNK, count))
        points, weight = normalized.points[:, span], normalized.visible[:, span]
        shown = (weight > 0).any(axis=0)
        points, weight = points[:, shown], weight[:, shown]
        if filling is not None:
            points, _ = filling.filled(points, weight)
        yield np.flatnonzero(shown) + span.start, points


def _carry(
    normalized: Normalized, filling: Filling | None, chosen: NDArray[np.intp], should_stop: ShouldStop
) -> tuple[Floats, Floats, Floats]:
    """Return Gram matrix, translations and centred sample, completed chunk by chunk; call `should_stop`, but ignore its result."""
    frames = len(normalized.points)
    gram, total = np.zeros((2 * frames, 2 * frames)), np.zeros((frames, 2))
    sample = np.zeros((frames, len(chosen), 2))
    used, often = 0, often_visible(normalized.visible)
    for number, (places, points) in enumerate(spans(normalized, filling), start=1):
        if number % CHUNKS_PER_TICK == 0:
            should_stop()
        inside = np.isin(places, chosen, assume_unique=True)
        sample[:, np.isin(chosen, places, assume_unique=True)] = points[:, inside]
        points = points[:, often[places]]
        stacked = columns(points)
        gram += stacked @ stacked.T
        total += points.sum(axis=1)
        used += points.shape[1]
    mean = total / used
    flat = mean.reshape(-1)
    return gram / used - np.outer(flat, flat), mean, sample - mean[:, None]


def _interpolated(points: Floats, weight: Floats) -> Floats:
    """Return starting values: hidden entries interpolated in time, distant ones clipped."""
    filled = points.copy()
    frames = np.arange(len(points))
    for index in np.flatnonzero((weight == 0).any(axis=0)):
        seen = weight[:, index] > 0
        for axis in (0, 1):
            filled[:, index, axis] = np.interp(frames, frames[seen], points[seen, index, axis]) if seen.any() else 0.0
    return np.clip(filled, -3.0, 3.0)


def _widen(basis: Floats, points: Floats, weight: Floats, start: Floats, rank: int) -> Floats:
    """Return a basis of `rank` columns: the given ones and the leading directions of their residual."""
    frames = len(points)
    if basis.shape[2] == 0:
        left, shift = start, start.mean(axis=1)
        old = np.zeros((frames, 2, 0))
    else:
        coefficients, _ = coefficients_of(points, weight, basis, None, 1.0, sweeps=2)
        left = points - predict(basis, coefficients)
        left *= _reweighted(_lengths(left), weight)[0][..., None]
        old, shift = basis[:, :, :-1], basis[:, :, -1]
    stacked = columns(centred(left))
    vectors = _leading(stacked, rank - 1 - old.shape[2])
    new = vectors.reshape(frames, 2, -1)
    return np.concatenate([old, new, shift[..., None]], axis=2)


def _orthonormal(basis: Floats) -> tuple[Floats, Floats]:
    """Return the basis with orthonormal columns (except the translation), and the matrix from old to new coefficients."""
    columns = basis[:, :, :-1]
    frames, _, rank = columns.shape
    unit, change = np.linalg.qr(columns.reshape(2 * frames, rank))
    return np.concatenate([unit.reshape(frames, 2, rank), basis[:, :, -1:]], axis=2), np.asarray(change)


def _prior(spread: Floats, scale: float) -> Floats:
    """Return σ² Σ⁻¹ for the covariance Σ; directions of vanishing variance get a large, finite precision."""
    size = len(spread)
    floor = 1e-8 * max(float(np.trace(spread)), 1e-12) / max(size, 1)
    return np.asarray(scale**2 * np.linalg.inv(spread + floor * np.eye(size)))


def _ridge(normal: Floats, share: float = COEFFICIENT_RIDGE) -> Floats:
    size = normal.shape[-1]
    mean = float(np.trace(normal.mean(axis=0))) / size
    return np.asarray(share * max(mean, 1e-12) * np.eye(size))


def _lengths(difference: Floats) -> Floats:
    return np.asarray(np.sqrt(difference[..., 0] ** 2 + difference[..., 1] ** 2))


def _reweighted(lengths: Floats, weight: Floats) -> tuple[Floats, float]:
    """Return the weights of the Cauchy loss for residuals of these lengths, at three times the residual scale, and that scale."""
    scale = max(_typical(lengths, weight), MIN_RESIDUAL_SCALE)
    return weight / (1 + (lengths / (3 * scale)) ** 2), scale


def _typical(lengths: Floats, weight: Floats) -> float:
    """Return the standard deviation per coordinate of an isotropic Gaussian with this median length, weighted by confidence."""
    mask = weight > 0
    return weighted_median(lengths[mask], weight[mask]) / RAYLEIGH_MEDIAN if mask.any() else 0.0


def _leading(matrix: Floats, count: int) -> Floats:
    """Return the `count` leading left singular vectors, through the Gram matrix of the shorter side."""
    rows, columns = matrix.shape
    if rows <= columns:
        return np.asarray(np.linalg.eigh(matrix @ matrix.T)[1][:, ::-1][:, :count])
    values, right = np.linalg.eigh(matrix.T @ matrix)
    values, right = values[::-1][:count], right[:, ::-1][:, :count]
    return np.asarray(np.asarray(matrix @ right) / np.sqrt(np.maximum(values, 1e-14 * max(float(values[0]), 1e-300))))

"""Robust observation model: which observations are inliers, and the moments of the complete tracks.

The image of a point over all frames is Gaussian, w ~ N(0, S), with S = ΠΣΠᵀ + σ²I (`ShapeCovariance.of_image`). An observation of
confidence v whose probability of being an inlier is π has noise σ²/(vπ); a hidden one has infinite noise. Only the entries M whose
noise is not σ² distinguish the observations from complete tracks. With K = S⁻¹, z the observations (0 where hidden) and
δ = σ²(1/(vπ) − 1) the noise beyond σ²,

    C = (K_MM + diag(1/δ))⁻¹,    E[w_M | z] = z_M − C (K z)_M,    Cov[w_M | z] = C,

while the other entries equal the observations. The inverse covariance of the observations is K − K_·M C K_M·, from which the prediction of
every observation from all others of its point follows (leave-one-out). A point costs O(|M|³ + F|M|²).

An observation is an inlier, or an outlier with a uniform density over an area A. With a share α of outliers and the predicted density p,

    π = (1 − α) p / ((1 − α) p + α / A),    α = mean of 1 − π.

A learned covariance makes overconfident predictions. Their covariances are therefore multiplied by a factor, at least 1, with which
the median of the squared Mahalanobis distances is that of a χ² distribution with two degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats
from pliant.solver.threads import SMALLEST, over_ranges
from pliant.solver.tracks.completion import MIN_RESIDUAL_SCALE
from scipy import linalg
from scipy.special import expit

MIN_INLIER_PROBABILITY = 1e-3
"""Floor of π where an observation is predicted from the others: keeps its own noise finite. Not tuned."""

SHARE_BOUNDS = (1e-3, 0.5)
"""Bounds of α: at 0 no observation could become an outlier, and beyond half the inliers are not the majority."""

CHI2_MEDIAN = float(2 * np.log(2))
"""Median of the χ² distribution with two degrees of freedom."""

CERTAIN = 0.99
"""Weight above which an observation counts in full: its noise is about 1 % larger at most, and only the others cost time."""

BATCH_NUMBERS = 4_000_000
"""Maximum number of entries of K_·M in memory at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Conditionals:
    """Posterior covariances of the complete tracks of some points, padded to the same number of rows."""

    points: NDArray[np.intp]
    """Shape `(n,)`."""

    rows: NDArray[np.intp]
    """Rows of the entries M, shape `(n, m)`; 0 where padded."""

    covariances: Floats
    """C, shape `(n, m, m)`; 0 where padded."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageDensity:
    """Gaussian density of complete tracks."""

    precision: Floats
    """K, shape `(2F, 2F)`, of the coordinates x1, y1, x2 and so on."""

    noise: float
    """σ²."""

    @classmethod
    def of(cls, covariance: Floats, noise: float, *, least: float = 0.0) -> ImageDensity:
        """Return the density for S, shape `(2F, 2F)`, which includes the noise σ²; noise below `least` is raised to it."""
        raised = max(least - noise, 0.0)
        factor = linalg.cho_factor(covariance + raised * np.eye(len(covariance)), lower=True, check_finite=False)
        precision = linalg.cho_solve(factor, np.eye(len(covariance)), check_finite=False)
        return cls((precision + precision.T) / 2, noise + raised)

    def moments(self, points: Floats, weight: Floats) -> tuple[Floats, Floats]:
        """Return the expected complete tracks and the sum of their covariances over the points.

        Parameters
        ----------
        points : array, shape (F, P, 2)
            Observations, 0 where hidden.
        weight : array, shape (F, P)
            vπ, 0 where hidden.

        Returns
        -------
        means (2F, P), covariance (2F, 2F)
        """
        size = len(self.precision)
        means = points.transpose(0, 2, 1).reshape(size, -1).copy()
        pulled, total = self.precision @ means, np.zeros((size, size))
        for found in self._conditionals(weight):
            moved = np.einsum("nij,nj->ni", found.covariances, pulled[found.rows, found.points[:, None]])
            np.subtract.at(means, (found.rows, found.points[:, None]), moved)
            np.add.at(total, (found.rows[:, :, None], found.rows[:, None, :]), found.covariances)
        return means, total

    def left_out(self, points: Floats, confidence: Floats, weight: Floats) -> tuple[Floats, Floats]:
        """Return how far each observation lies from its prediction by the other observations of its point.

        Parameters
        ----------
        points : array, shape (F, P, 2)
            Observations, 0 where hidden.
        confidence : array, shape (F, P)
            v, 0 where hidden: the observation itself counts with the noise σ²/v of an inlier.
        weight : array, shape (F, P)
            vπ: the others count with the noise σ²/(vπ).

        Returns
        -------
        distances, determinants, shape (F, P)
            Squared Mahalanobis distances, and determinants of the predicted covariances; 0 and 1 where hidden.
        """
        seen = confidence > 0
        weight = np.where(seen, np.maximum(weight, MIN_INLIER_PROBABILITY * confidence), 0.0)
        pulled = self.precision @ points.transpose(0, 2, 1).reshape(len(self.precision), -1)
        xx, yy, xy = (
            np.repeat(self.precision[i::2, j::2].diagonal()[:, None], pulled.shape[1], axis=1)
            for i, j in ((0, 0), (1, 1), (0, 1))
        )
        for found in self._conditionals(weight):

            def work(start: int, stop: int, found: Conditionals = found) -> None:
                rows, at = found.rows[start:stop], found.points[start:stop]
                columns = self.precision[:, rows].transpose(1, 0, 2)  # (n, 2F, m)
                spread = columns @ found.covariances[start:stop]
                pulled[:, at] -= np.einsum("nfi,ni->fn", spread, pulled[rows, at[:, None]])
                for block, i, j in ((xx, 0, 0), (yy, 1, 1), (xy, 0, 1)):
                    block[:, at] -= np.einsum("nfi,nfi->fn", spread[:, i::2], columns[:, j::2])

            over_ranges(work, len(found.points), smallest=max(1, SMALLEST // (len(pulled) * found.rows.shape[1])))
        confidence, weight = np.where(seen, confidence, 1.0), np.where(seen, weight, 1.0)
        xx, yy, xy = np.where(seen, xx, 1.0), np.where(seen, yy, 1.0), np.where(seen, xy, 0.0)
        pulled = np.where(np.repeat(seen, 2, axis=0), pulled, 0.0)
        return _predicted(pulled, (xx, yy, xy), self.noise * (1 / confidence - 1 / weight))

    def _conditionals(self, weight: Floats) -> Iterator[Conditionals]:
        """Yield batches of points with entries of weight below `CERTAIN`, sorted by the number of these entries."""
        changed = weight < CERTAIN
        counts = changed.sum(axis=0)
        order = np.argsort(counts, kind="stable")
        order = order[np.searchsorted(counts[order], 1) :]
        while len(order):
            pulse()
            most = int(counts[order[-1]])
            size = max(1, BATCH_NUMBERS // (2 * most * len(self.precision)))
            some, order = order[-size:], order[:-size]
            yield self._conditionals_of(some, weight[:, some], most)

    def _conditionals_of(self, points: NDArray[np.intp], weight: Floats, most: int) -> Conditionals:
        changed = weight < CERTAIN
        frames = np.argsort(~changed, axis=0, kind="stable")[:most].T  # (n, most), the changed ones first
        real = np.repeat(np.take_along_axis(changed.T, frames, axis=1), 2, axis=1)
        rows = np.repeat(2 * frames, 2, axis=1)
        rows[:, 1::2] += 1
        own = np.repeat(np.take_along_axis(weight.T, frames, axis=1), 2, axis=1)
        added = np.where(real, own / np.where(real, 1 - own, 1.0) / self.noise, 1.0)
        places, covariances = np.arange(2 * most), np.zeros((len(points), 2 * most, 2 * most))

        def work(start: int, stop: int) -> None:
            at, inside = rows[start:stop], real[start:stop]
            inner = self.precision[at[:, :, None], at[:, None, :]] * (inside[:, :, None] & inside[:, None, :])
            inner[:, places, places] += added[start:stop]
            inverse = np.linalg.inv(inner)
            inverse[:, places, places] *= inside
            covariances[start:stop] = (inverse + inverse.transpose(0, 2, 1)) / 2

        over_ranges(work, len(points), smallest=max(1, SMALLEST // (2 * most) ** 2))
        return Conditionals(points, np.where(real, rows, 0), covariances)


def _predicted(pulled: Floats, blocks: tuple[Floats, Floats, Floats], own: Floats) -> tuple[Floats, Floats]:
    """Return distances and determinants from S⁻¹z `(2F, P)`, the blocks of S⁻¹ (xx, yy, xy) and variance to add `(F, P)`."""
    xx, yy, xy = blocks
    size = xx * yy - xy**2
    size = np.where(size > 0, size, 1.0)
    a, b, c = yy / size, xx / size, -xy / size
    x, y = pulled[0::2], pulled[1::2]
    right, up = a * x + c * y, c * x + b * y
    a, b = a + own, b + own
    size = np.maximum(a * b - c**2, np.finfo(float).tiny)
    return np.asarray((b * right**2 - 2 * c * right * up + a * up**2) / size), size


def inlier_probabilities(
    covariance: Floats, noise: float, points: Floats, confidence: Floats, weight: Floats, *, share: float
) -> tuple[Floats, float]:
    """Return the inlier probability of every observation, shape `(F, P)`, 0 where hidden, and the share of outliers.

    The noise standard deviation is at least `completion.MIN_RESIDUAL_SCALE`: predictions of a covariance learned without noise claim more
    precision than the model has.

    Parameters
    ----------
    covariance : array, shape (2F, 2F)
        S.
    noise : float
        σ².
    points : array, shape (F, P, 2)
        Observations, 0 where hidden.
    confidence : array, shape (F, P)
        v, 0 where hidden.
    weight : array, shape (F, P)
        vπ, the weight of an observation in the predictions of the others.
    share : float
        α to start from.
    """
    seen, found = confidence > 0, np.zeros(confidence.shape)
    if not seen.any():
        return found, share
    density = ImageDensity.of(covariance, noise, least=MIN_RESIDUAL_SCALE**2)
    distances, determinants = density.left_out(points, confidence, weight)
    extent = np.maximum(np.ptp(points[seen], axis=0), MIN_RESIDUAL_SCALE)
    size = max(1.0, float(np.median(distances[seen])) / CHI2_MEDIAN)
    logs = -distances[seen] / (2 * size) - np.log(2 * np.pi * size) - np.log(determinants[seen]) / 2
    share = float(np.clip(share, *SHARE_BOUNDS))
    found[seen] = expit(logs + np.log(np.prod(extent)) + np.log((1 - share) / share))
    return found, float(np.clip(1 - found[seen].mean(), *SHARE_BOUNDS))

"""Posterior probability that an observation is an inlier.

An observation is either an inlier, whose residual r in the image has the density of the solver's loss, or an outlier, uniform over
the area A that the tracks cover about their frames' centroids. With a share α of outliers,

    P(inlier | r) = (1 − α) p(r) / ((1 − α) p(r) + α / A).

For an observation of confidence v the density is `p(r) = v² / (2 s²) exp(−√2 v (|r_x| + |r_y|) / s)` with the loss `l1`, whose smoothed
absolute value is the negative logarithm of a Laplace density of standard deviation s, and `p(r) = v / (2π s²) exp(−v |r|² / 2s²)` with
the other losses. s is the larger of two standard deviations: that of the noise assumed by the solve (`Choices.noise`), and that of the
residuals, which exceeds it if the model does not fit: their confidence-weighted median length over √(2 ln 2). If n of N visible
observations are rejected, α = (n + 1) / (N + 2), the mean under a uniform prior (Laplace's rule of succession).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.limits import frame_chunks
from pliant.solver.pulse import ShouldStop, never, pulse
from pliant.solver.records import Floats, Tracks
from pliant.solver.solution import Solution
from pliant.solver.tracks.noise import weighted_median
from pliant.solver.tracks.normalization import relative
from scipy.special import expit

MEDIAN_LENGTH = float(np.sqrt(2 * np.log(2)))
"""Median length of a vector with two standard normal coordinates."""


def with_inlier_probability(
    solution: Solution,
    tracks: Tracks,
    confidence: Floats,
    *,
    full_confidence: float,
    loss: str,
    should_stop: ShouldStop = never,
) -> Solution:
    """Return the solution with the inlier probability of every observation.

    Parameters
    ----------
    solution : Solution
        With its final cameras.
    tracks : Tracks
        All observations.
    confidence : ndarray, shape (F, P)
        Confidence of the observations used; 0 where rejected.
    full_confidence : float
        Confidence of the tracks that counts as 1.
    loss : {"l1", "l2", "huber"}
        Loss of the data term.
    should_stop : callable, optional
        Called between units of work to report progress; its result is ignored.
    """
    seen = tracks.visible > 0
    rejected = seen & (confidence == 0)
    left, low, high = np.empty_like(tracks.points), np.full(2, np.inf), np.full(2, -np.inf)
    for some in frame_chunks(*seen.shape):
        camera = solution.camera.at(some)
        np.subtract(tracks.points[some], camera.project(solution.shapes[some]), out=left[some])
        placed = (tracks.points[some] - camera.translations[:, None])[seen[some]]
        low = np.minimum(low, placed.min(axis=0, initial=np.inf))
        high = np.maximum(high, placed.max(axis=0, initial=-np.inf))
        should_stop()
    probability = inlier_probability(
        left,
        relative(tracks.visible, full_confidence),
        rejected,
        noise_std=solution.choices.noise,
        extent=high - low,
        loss=loss,
    )
    return replace(solution, inlier_probability=probability)


def inlier_probability(
    left: Floats, confidence: Floats, rejected: np.ndarray, *, noise_std: float, extent: Floats, loss: str
) -> Floats:
    """Return the inlier probability of every observation, shape `(F, P)`: 0 where rejected, NaN where hidden.

    Parameters
    ----------
    left : ndarray, shape (F, P, 2)
        Residuals.
    confidence : ndarray, shape (F, P)
        v; 0 where hidden.
    rejected : ndarray of bool, shape (F, P)
        Visible observations that were not used.
    noise_std : float
        Standard deviation of an image coordinate, in the unit of the residuals.
    extent : ndarray, shape (2,)
        Width and height of the area of the outliers, in the same unit.
    loss : str
        ``"l1"``, ``"l2"`` or ``"huber"``. Selects the density of the inliers.
    """
    seen, found = confidence > 0, np.full(confidence.shape, np.nan)
    used = seen & ~rejected
    found[rejected] = 0.0
    if not used.any():
        return found
    pulse()
    lengths = np.hypot(left[..., 0], left[..., 1])[used]
    pulse()
    typical = weighted_median(lengths, confidence[used]) / MEDIAN_LENGTH
    del lengths
    scale = max(noise_std, typical, float(np.finfo(float).tiny) ** 0.25)
    area = float(np.prod(np.asarray(extent) / scale + 1))  # in units of s²; adding 1 keeps an extent of 0 positive
    odds = (seen.sum() - rejected.sum() + 1) / (rejected.sum() + 1)
    for some in frame_chunks(*used.shape):
        chosen = used[some]
        logs = _log_density(left[some][chosen] / scale, confidence[some][chosen], loss)
        found[some][chosen] = np.maximum(expit(logs + np.log(area) + np.log(odds)), np.finfo(np.float64).tiny)
    return found


def _log_density(residual: Floats, weight: Floats, loss: str) -> Floats:
    """Return the log density of residuals `(N, 2)`, in units of s, with confidences `(N,)`."""
    if loss == "l1":
        logs = 2 * np.log(weight) - np.log(2) - np.sqrt(2) * weight * np.abs(residual).sum(axis=1)
    else:
        logs = np.log(weight / (2 * np.pi)) - weight * np.square(residual).sum(axis=1) / 2
    return np.asarray(logs)

"""Rejection of gross outliers before the shapes are fitted.

With a loss of slope 1, an outlier of one RMS radius costs as much as the noise of a hundred good observations, so shapes under a prior
weighted for the noise follow outliers. An observation is therefore rejected if it is more probably an outlier than not, given the other
observations of its point, the cameras and the learned covariance (`model.observation_model`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.solver.limits import LEARNED_FRAMES
from pliant.solver.model.observation_model import inlier_probabilities
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.pulse import ShouldStop
from pliant.solver.records import Floats
from pliant.solver.tracks.completion import POINTS_PER_CHUNK, Filling
from pliant.solver.tracks.normalization import Normalized


def gross_outliers(
    flat: Normalized,
    projections: Floats,
    translations: Floats,
    covariance: ShapeCovariance,
    filling: Filling,
    *,
    share: float,
    should_stop: ShouldStop,
) -> NDArray[np.bool_]:
    """Return the observations that are more probably outliers than not, shape `(F, P)`.

    Parameters
    ----------
    flat : Normalized
        Tracks corrected for perspective.
    projections : array, shape (F, 2, 3)
        s_f times the first two rows of R_f.
    translations : array, shape (F, 2)
        Translations of the cameras, normalized units.
    covariance : ShapeCovariance
        Prior of all frames.
    filling : Filling
        Model of the completed tracks; its outliers initialise the search.
    share : float
        Estimated share of outliers.
    should_stop : callable
        Called between chunks; once it returns True, the outliers found so far are returned.
    """
    found = np.zeros(flat.visible.shape, dtype=bool)
    frames = len(projections)
    windows = np.array_split(np.arange(frames), -(-frames // LEARNED_FRAMES))
    images = [covariance.of_image(projections[window], window) for window in windows]
    for first in range(0, flat.visible.shape[1], POINTS_PER_CHUNK):
        span = slice(first, first + POINTS_PER_CHUNK)
        confidence = flat.visible[:, span]
        weight = np.where(filling.outliers(flat.points[:, span], confidence), 0.0, confidence)
        points = np.where(confidence[..., None] > 0, flat.points[:, span] - translations[:, None], 0.0)
        for window, image in zip(windows, images, strict=True):
            if should_stop():
                return found
            probability, _ = inlier_probabilities(
                image, covariance.noise_variance, points[window], confidence[window], weight[window], share=share
            )
            found[window, span] = (confidence[window] > 0) & (probability < 0.5)
    return found

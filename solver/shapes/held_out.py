"""Prediction of observations that were held out: what cameras and prior say about images that they were not computed from.

The images of one point over all frames, w ∈ R^{2F}, are N(0, V), V = Π Σ Πᵀ + σ² W⁻¹ (`model.image_density`). Without the observations of
a block B of frames, their prediction from the others is off by

    e_B = [V⁻¹]_BB⁻¹ [V⁻¹ w]_B,    with covariance [V⁻¹]_BB⁻¹,

which is the result of a solve without them at the cost of one with them (Rasmussen and Williams, Gaussian Processes for Machine Learning,
2006, equations 5.10 to 5.12, here for blocks).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.records import Floats
from scipy import linalg


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Held-out observations of one point against their prediction from its others."""

    errors: Floats
    """Observed minus predicted, shape `(N, 2)`, the unit of the images."""

    variances: Floats
    """Variances of the same, by the model, shape `(N, 2)`."""


def predicted(covariance: Floats, images: Floats, blocks: list[NDArray[np.intp]]) -> Prediction:
    """Leave out the observations of each block in turn and predict them from all others.

    Parameters
    ----------
    covariance : ndarray, shape (2N, 2N)
        V of N observed images, both coordinates of an image side by side, with their noise.
    images : ndarray, shape (N, 2)
    blocks : list of ndarray
        Numbers below N. What is in no block is not predicted.

    Raises
    ------
    numpy.linalg.LinAlgError
        V is not positive definite.
    """
    inverse = linalg.cho_solve(linalg.cho_factor(covariance, lower=True, check_finite=False), np.eye(len(covariance)))
    weighted = inverse @ images.reshape(-1)
    errors, variances = [], []
    for block in blocks:
        rows = (2 * block[:, None] + [0, 1]).reshape(-1)
        left = linalg.inv(inverse[np.ix_(rows, rows)], check_finite=False)
        errors.append((left @ weighted[rows]).reshape(-1, 2))
        variances.append(np.diag(left).reshape(-1, 2))
    return Prediction(np.concatenate(errors), np.concatenate(variances))

"""Coordinates over the frames in which the likelihood is about equally steep in all directions.

With V the covariance of a point's images (`model.image_density`), the expected second derivative of the negative log-likelihood for a
change dQ of columns that explain much of V is tr dQᵀV⁻¹dQ: a change over time that the modes or the random walk explain costs little, one
that they do not explain costs 1/σ², a million times as much. Quasi-Newton steps in the parameters themselves are therefore slow. In
coordinates z with x = R z over the frames, R Rᵀ = σ²I + τT + L Lᵀ, the cost is about 1 for all: natural coordinates in the sense of
Amari (1998), "Natural gradient works efficiently in learning", with the metric of the start.

T is nearly diagonal in cosines over the frames, and L Lᵀ has low rank, so R is applied in time linear in the frames, up to a logarithm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pliant.solver.model.random_walk import LEVEL, walk_bands
from pliant.solver.records import Floats
from scipy.fft import dct, idct


@dataclass(frozen=True, slots=True, eq=False)
class FrameMetric:
    """R in factored form: spectrum times identity plus low rank."""

    spectrum: Floats
    """Standard deviations of σ²I + τT in its eigenvectors, shape `(F, 1)`."""

    vectors: Floats
    """Orthonormal directions of L Lᵀ, in the eigenvectors of T and relative to the spectrum, shape `(F, k)`."""

    gains: Floats
    """Standard deviations along `vectors`, relative to the spectrum, at least 1, shape `(k, 1)`."""

    ordered: bool
    """True if T is a random walk, whose eigenvectors are cosines over the frames; False if T is the identity."""

    @classmethod
    def of(cls, modes: Floats, *, noise_variance: float, walk_variance: float, ordered: bool) -> FrameMetric:
        """Return the root of σ²I + τT + L Lᵀ, L of shape `(F, q)`."""
        frames = len(modes)
        walk = np.ones(frames)
        if ordered:
            stiffness = 4 * np.sin(np.pi * np.arange(frames) / (2 * frames)) ** 2 + LEVEL / frames**2
            walk = 1 / (walk_bands(frames, ordered=True)[1] * stiffness)
        spectrum = np.sqrt(noise_variance + walk_variance * walk)[:, None]
        vectors, values, _ = np.linalg.svd(
            (dct(modes, axis=0, norm="ortho") if ordered else modes) / spectrum, full_matrices=False
        )
        return cls(spectrum, vectors, np.sqrt(1 + values**2)[:, None], ordered)

    def parameters(self, coordinates: Floats) -> Floats:
        """Return R z, shape `(F, n)`."""
        values = self.spectrum * self._stretched(coordinates, self.gains)
        return np.asarray(idct(values, axis=0, norm="ortho")) if self.ordered else values

    def coordinates(self, parameters: Floats) -> Floats:
        """Return R⁻¹ x, shape `(F, n)`."""
        return self._stretched(self._eigen(parameters) / self.spectrum, 1 / self.gains)

    def gradient(self, by_parameters: Floats) -> Floats:
        """Return Rᵀ g, the gradient with respect to the coordinates, shape `(F, n)`."""
        return self._stretched(self._eigen(by_parameters) * self.spectrum, self.gains)

    def _eigen(self, values: Floats) -> Floats:
        return np.asarray(dct(values, axis=0, norm="ortho")) if self.ordered else values

    def _stretched(self, values: Floats, gains: Floats) -> Floats:
        result: Floats = values + self.vectors @ ((gains - 1) * (self.vectors.T @ values))
        return result

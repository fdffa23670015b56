"""Gaussian shape prior: covariance of point positions over frames and axes, learned from the tracks.

A point's world positions over all frames, x ∈ R^{3F}, are draws from one zero-mean Gaussian with covariance

    Σ = 1 1ᵀ ⊗ A₀  +  C ⊗ A₁,    C = L Lᵀ + τ T,

that is, a mean position with covariance A₀ (3×3) and a deformation with covariance C over frames (F×F: modes L, and a
random walk T for the remainder) and A₁ over axes (3×3, trace 3). The tracks observe two of three coordinates per
frame, W = Π X + noise of variance σ² with Π = blockdiag(s_f R_f). The unobserved coordinate is integrated out, so
unknown depth is not treated as flat, whereas a penalty on the estimated shapes (`pliant.solver.energy.low_rank`)
shrinks depth.

`model.expectation_maximisation` learns the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.model.image_density import ImageModel
from pliant.solver.model.marginal_likelihood import root_matrix
from pliant.solver.model.random_walk import random_walk, random_walk_at, walk_bands, walked
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.records import Floats
from pliant.solver.tracks.frame_selection import between
from scipy import linalg

AXIS_VARIANCE_FLOOR = 1e-3
"""Floor of the deformation variance along an axis, relative to a mean of 1: keeps A₁ invertible."""

NOISE_VARIANCE_FLOOR = 1e-8
"""Floor of σ², normalized units squared."""


@dataclass(frozen=True, slots=True, eq=False)
class ShapeCovariance:
    """Prior covariance Σ of a point's path and the noise, normalized units."""

    mean_covariance: Floats
    """A₀, covariance of the mean position, shape `(3, 3)`."""

    axis_covariance: Floats
    """A₁, covariance of the deformation over axes, shape `(3, 3)`, trace 3."""

    modes: Floats
    """L, shape `(F, k)`."""

    walk_variance: float
    """τ, variance of the random walk."""

    noise_variance: float
    """σ², variance of an image coordinate."""

    nll: float
    """Negative log likelihood, per point and frame, of the covariance before the last EM round; ∞ at the start."""

    ordered: bool = True
    """Whether T is a random walk over frames; for photographs in no order it is the identity."""

    def over_frames(self) -> Floats:
        """Return C, shape `(F, F)`."""
        covariance: Floats = self.modes @ self.modes.T + self.walk_variance * random_walk(len(self.modes), self.ordered)
        return covariance

    def over_frames_at(self, used: NDArray[np.intp]) -> Floats:
        """Return C restricted to the frames used, shape `(F', F')`."""
        modes = self.modes[used]
        walk = random_walk_at(used, len(self.modes), self.ordered)
        return np.asarray(modes @ modes.T + self.walk_variance * walk)

    def num_deforming(self) -> int:
        """Return the number of independent deformations whose variance, as a mean over frames, exceeds that of the noise.

        Modes below it fit noise. A mode that is constant over time belongs to the mean position and does not count.
        """
        moving = self.modes - self.modes.mean(axis=0)
        variances = np.linalg.svd(moving, compute_uv=False) ** 2 / len(moving)
        return int((variances * np.trace(self.axis_covariance) / 3 > self.noise_variance).sum())

    def times(self, columns: Floats) -> Floats:
        """Return C times columns of shape `(F, n)`, in time and memory linear in F."""
        deformed = self.modes @ (self.modes.T @ columns)
        return np.asarray(deformed + self.walk_variance * walked(columns, self.ordered))

    def of_exact_image(self, projections: Floats, used: NDArray[np.intp] | None = None) -> Floats:
        """Return ΠΣΠᵀ, shape `(2F, 2F)`; `projections` (F, 2, 3) are s_f times the first two rows of R_f.

        With `used`, both cover these frames only.
        """
        rows = projections.reshape(-1, 3)
        over_frames = self.over_frames() if used is None else self.over_frames_at(used)
        wide = np.repeat(np.repeat(over_frames, 2, axis=0), 2, axis=1)
        return np.asarray(rows @ self.mean_covariance @ rows.T + (rows @ self.axis_covariance @ rows.T) * wide)

    def of_image(self, projections: Floats, used: NDArray[np.intp] | None = None) -> Floats:
        """Return V = ΠΣΠᵀ + σ²I; arguments as for `of_exact_image`."""
        image = self.of_exact_image(projections, used)
        image[np.diag_indices(len(image))] += self.noise_variance
        return image

    def image_model(self, projections: Floats) -> ImageModel:
        """Return V in factored form."""
        frames, walk = len(projections), projections @ root_matrix(self.axis_covariance)
        middle = (projections @ root_matrix(self.mean_covariance))[:, :, None]
        columns = np.concatenate([middle, self.modes[:, None, :, None] * walk[:, :, None]], axis=2)
        return ImageModel(columns.reshape(2 * frames, -1), walk, self.noise_variance, self.walk_variance, self.ordered)

    def axes(self) -> tuple[Floats, Floats]:
        """Return B (3×3) and a (3,) with A₁ = B Bᵀ and A₀ = B diag(a) Bᵀ: the coordinates of y, x = B y, are independent."""
        values, vectors = linalg.eigh(self.mean_covariance, self.axis_covariance)
        return np.asarray(np.linalg.inv(vectors).T, dtype=np.float64), np.maximum(values, 0.0)

    def precisions(self) -> tuple[Floats, PathPrior]:
        """Return B (3×3) and the inverse covariance over frames of each coordinate of y = B⁻¹x."""
        basis, mean_moments = self.axes()
        chain, norm = walk_bands(len(self.modes), self.ordered)
        first, second, third = (
            np.column_stack([self.modes, np.full(len(self.modes), mean_covariance**0.5)])
            for mean_covariance in mean_moments
        )
        return basis, PathPrior.of(chain * (norm / self.walk_variance), (first, second, third))

    def turned(self, axes: Floats) -> ShapeCovariance:
        """Return the covariance of the coordinates `axes` x, for a 3×3 matrix: a rotation, a reflection or a stretch."""
        return replace(
            self,
            mean_covariance=axes @ self.mean_covariance @ axes.T,
            axis_covariance=axes @ self.axis_covariance @ axes.T,
        )

    def stretched(self, used: NDArray[np.intp], num_frames: int) -> ShapeCovariance:
        """Return the covariance of all `num_frames` frames when this one covers the frames `used`.

        Modes are interpolated linearly between them, the conditional mean of a random walk.
        """
        return replace(self, modes=between(used, self.modes, num_frames))

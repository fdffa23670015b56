"""Perspective correction of the tracks: one scalar on top of a scaled-orthographic estimator.

A pinhole camera with focal length φ sees a point of a shape whose origin lies at depth φ/s_f (camera axes x right, y down, z away) at

    u = c + (s_f R_f[:2] x + t_f) / (1 + z/φ),    z = s_f R_f[2] x,

with c the principal point, t_f the image of the shape's origin relative to c, and z the depth beyond the origin in image units. So

    (u − c) (1 + z/φ) = s_f R_f[:2] x + t_f

is exactly a scaled-orthographic track of the same shape. Depths follow from the shapes, shapes from the corrected tracks; κ = 1/φ is
the only new unknown, and κ = 0 is scaled orthography. Reversing the sign of κ is equivalent to mirroring all depths, x → J x, R → J R J
with J = diag(1, 1, −1), which orthography cannot distinguish.

Depths are posterior means under the Gaussian of `pliant.solver.model.shape_covariance`, which are linear in the corrected tracks:

    z = D w,    D = E Σ Πᵀ (Π Σ Πᵀ + σ²I)⁻¹,    E = blockdiag(s_f R_f[2]).

With v the tracks relative to the principal point, w = v ∘ (1 + κ D w) is solved by cheap fixed-point steps in 2F dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from pliant.solver.limits import LEARNED_FRAMES
from pliant.solver.model.image_density import Explained, ImageModel
from pliant.solver.model.marginal_likelihood import root_matrix
from pliant.solver.model.resection import MIN_RELATIVE_DISTANCE
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.model.so3 import MIRROR
from pliant.solver.records import Floats, projections_of
from pliant.solver.tracks.completion import Filling, often_visible, spans
from pliant.solver.tracks.matrix import centred, columns
from pliant.solver.tracks.normalization import Normalized
from scipy import linalg

DEPTH_STEPS = 8
"""Fixed-point steps for the depths. Each leaves about κ|v| ≤ .3 of the error: about 1e-4 of a depth after the last."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """D in factored form, for films whose F × 2F matrix would be too large: a product is linear in the frames."""

    away: Floats
    """E, shape `(F, 3)`."""

    model: ImageModel
    covariance: ShapeCovariance

    def __matmul__(self, images: Floats) -> Floats:
        """Return the posterior mean depths, `(F, n)`, of points with centred image coordinates `(2F, n)`."""
        covariance, frames = self.covariance, len(self.away)
        found = Explained.of(self.model, images)
        means = found.means.reshape(-1, 3, images.shape[1])
        moved = (covariance.modes @ means[1:].reshape(len(means) - 1, -1)).reshape(frames, 3, -1) + found.strayed
        middle = self.away @ root_matrix(covariance.mean_covariance) @ means[0]
        return np.asarray(middle + np.einsum("fc,fcn->fn", self.away @ root_matrix(covariance.axis_covariance), moved))


@dataclass(frozen=True, slots=True)
class Candidate:
    """A value of κ that was compared, and its score."""

    inverse_focal: float
    """κ, inverse normalized units; if negative, depth is minus the third camera coordinate."""

    nll: float
    """Negative log likelihood of the tracks per point and frame, including the density of the correction."""


@dataclass(frozen=True, slots=True, eq=False)
class Perspective:
    """Given and estimated perspective parameters, with the data that the correction of the tracks needs."""

    offsets: Floats
    """Centroid of each frame relative to the principal point, normalized units, shape `(F, 2)`."""

    principal_point: Floats
    """Shape `(2,)`, the tracks' unit."""

    inverse_focal: float = 0.0
    """κ = 1/φ, inverse normalized units; 0: orthography. Its final sign is `signs[0]`: positive if the third axis points away."""

    inverse_focal_std: float | None = None
    """Standard deviation of κ; None if κ is given, or no values on both sides of it were compared."""

    given: float | None = None
    """κ of a given focal length; None if none is given."""

    signs: tuple[int, ...] = (1, -1)
    """Signs of κ to compare; given cameras admit only the first."""

    required: bool = False
    """Whether the camera model is `perspective`; κ = 0 then serves only for comparison."""

    flipped: int = 1
    """−1 if all depths, and the sign of `inverse_focal`, were reversed after the comparison."""

    sign_known: bool = False
    """Whether the sign of depth is known."""

    candidates: tuple[Candidate, ...] = ()
    """Every κ compared, in increasing order."""

    filling: Filling | None = None
    """How hidden entries are completed; None if there are none."""

    learning_sample: Floats = field(default_factory=lambda: np.zeros((0, 0, 2)))
    """Complete, uncorrected tracks from which κ is learned, those of sampled points that are hidden only briefly, relative to the principal
    point, shape `(F, S', 2)`, normalized units."""

    full_sample: Floats = field(default_factory=lambda: np.zeros((0, 0, 2)))
    """The same of all sampled points, shape `(F, S, 2)`."""

    depth: Floats | DepthMap = field(default_factory=lambda: np.zeros((0, 0)))
    """D of the latest cameras and covariance, shape `(F, 2F)`, or in factored form in long films."""

    @property
    def is_perspective(self) -> bool:
        """Whether the tracks are corrected for perspective."""
        return self.inverse_focal != 0

    def focal_std(self, unit: float) -> float | None:
        """Return the standard deviation of φ, 0 if φ is given, None if unknown; a normalized unit is `unit` of the result."""
        if self.given is not None:
            return 0.0
        return None if self.inverse_focal_std is None else unit * self.inverse_focal_std / self.inverse_focal**2


def depth_map(rotations: Floats, scales: Floats, covariance: ShapeCovariance) -> Floats | DepthMap:
    """Return D, shape `(F, 2F)`, which maps centred image coordinates x1, y1, x2 … of a point to its depths."""
    if len(rotations) > LEARNED_FRAMES:
        away = rotations[:, 2] * scales[:, None]
        return DepthMap(away, covariance.image_model(projections_of(rotations, scales)), covariance)
    projections = projections_of(rotations, scales)
    away, rows = rotations[:, 2] * scales[:, None], projections.reshape(-1, 3)
    wide = np.repeat(covariance.over_frames(), 2, axis=1)
    cross = away @ covariance.mean_covariance @ rows.T + (away @ covariance.axis_covariance @ rows.T) * wide
    factor = linalg.cho_factor(covariance.of_image(projections))  # `solve` would warn of hardly observed tracks
    return np.ascontiguousarray(linalg.cho_solve(factor, cross.T)).T


def depths_of(
    depth: Floats | DepthMap,
    views: Floats,
    inverse_focal: float,
    *,
    origin: Floats | None = None,
) -> Floats:
    """Return posterior mean depths of points, shape `(F, P)`, relative to their mean in every frame or to `origin`.

    Parameters
    ----------
    depth : array, shape (F, 2F), or DepthMap
        From `depth_map`.
    views : array, shape (F, P, 2)
        Complete tracks relative to the principal point, normalized units.
    inverse_focal : float
        κ.
    origin : array, shape (F, 1), optional
        From `mean_depth`, for some of the points: their own mean would be another origin than that of the others.
    """
    depths = np.zeros(views.shape[:2])
    for _ in range(DEPTH_STEPS if inverse_focal else 1):
        images = corrected(views, depths, inverse_focal)
        if origin is None:
            depths = depth @ columns(centred(images))
            depths -= depths.mean(axis=1, keepdims=True)
        else:
            depths = depth @ columns(images) - origin
    return depths


def mean_depth(view: Perspective) -> Floats:
    """Return the mean of D w over the sample, shape `(F, 1)`: the origin of its depths, and of those of all other points.

    Scales and κ are learned from the sample. With the mean of all points as origin, which differs in depth, the errors at 3, 5 and 10
    half-sizes are 1.06 to 1.18 times as large for face scans and a speaking head, .99 times for a horse (1,000 points).
    """
    images = _corrected_by(view, view.learning_sample)
    return np.asarray(view.depth @ columns(images.mean(axis=1, keepdims=True)))


def corrected(views: Floats, depths: Floats, inverse_focal: float) -> Floats:
    """Return v (1 + κz): the scaled-orthographic tracks of the same shapes, about the principal point, shape `(F, P, 2)`."""
    return np.asarray(views * np.maximum(1 + inverse_focal * depths, MIN_RELATIVE_DISTANCE)[..., None])


def density(depths: Floats, inverse_focal: float) -> float:
    """Return −2 mean log(1 + κz): what the change of variables u → u (1 + κz) adds to the negative log likelihood."""
    return -2 * float(np.log(np.maximum(1 + inverse_focal * depths, MIN_RELATIVE_DISTANCE)).mean())


def mirrored(rotations: Floats, covariance: ShapeCovariance) -> tuple[Floats, ShapeCovariance]:
    """Return cameras and covariance with all depths reversed; orthographic images do not change."""
    return MIRROR @ rotations @ MIRROR, covariance.turned(MIRROR)


def corrected_moments(view: Perspective, normalized: Normalized) -> tuple[Floats, Floats, Floats]:
    """Return Gram matrix, translations and centred sample of the corrected tracks, as completion does of uncorrected ones.

    Parameters
    ----------
    view : Perspective
        Provides κ, the sample and D.
    normalized : Normalized
        The uncorrected tracks.

    Returns
    -------
    gram (2F, 2F), translations (F, 2), sample (F, S, 2)
        Translations are relative to the centroids of the visible points.
    """
    frames = len(normalized.points)
    gram, total, used = np.zeros((2 * frames, 2 * frames)), np.zeros((frames, 2)), 0
    origin = mean_depth(view)
    often = often_visible(normalized.visible)
    for places, points in spans(normalized, view.filling):
        points = points[:, often[places]]
        changed = _corrected_by(view, points + view.offsets[:, None], origin) - view.offsets[:, None]
        stacked = columns(changed)
        gram += stacked @ stacked.T
        total += changed.sum(axis=1)
        used += points.shape[1]
    mean = total / used
    flat = mean.reshape(-1)
    return gram / used - np.outer(flat, flat), mean, centred(_corrected_by(view, view.full_sample, origin))


def _corrected_by(view: Perspective, views: Floats, origin: Floats | None = None) -> Floats:
    return corrected(views, depths_of(view.depth, views, view.inverse_focal, origin=origin), view.inverse_focal)


def posterior_depths(view: Perspective, normalized: Normalized) -> Floats:
    """Return the depth of every point and frame, shape `(F, P)`; 0 for points that no frame shows."""
    found, origin = np.zeros(normalized.visible.shape), mean_depth(view)
    for places, points in spans(normalized, view.filling):
        views = points + view.offsets[:, None]
        found[:, places] = depths_of(view.depth, views, view.inverse_focal, origin=origin)
    return found


def orthographic(normalized: Normalized, view: Perspective | None) -> Normalized:
    """Return the tracks corrected with posterior depths, relative to the centroids of the uncorrected tracks.

    Without perspective, `normalized` itself is returned.
    """
    if view is None or not view.is_perspective:
        return normalized
    return corrected_tracks(normalized, view, posterior_depths(view, normalized))


def corrected_tracks(normalized: Normalized, view: Perspective, depths: Floats) -> Normalized:
    """Return the tracks corrected with depths `(F, P)`, relative to the centroids of the uncorrected tracks."""
    views = normalized.points + view.offsets[:, None]
    points = corrected(views, depths, view.inverse_focal) - view.offsets[:, None]
    return replace(normalized, points=np.where(normalized.visible[..., None] > 0, points, 0.0))

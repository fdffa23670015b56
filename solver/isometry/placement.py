"""Positions of points on the template of a surface.

In every frame, splines through the anchors map the template to space, and the camera maps space to the image. A point's position on the
template is where its images are nearest to its tracks. The way back, from the image to the template, is not a function: a sheet that is
seen from its edge or rolled up covers itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.isometry.inextensible import Indices
from pliant.solver.isometry.refinement import MOST_DAMPED
from pliant.solver.isometry.splines import spline_basis, spline_coefficients, spline_slopes
from pliant.solver.limits import CHUNK_OBSERVATIONS
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats
from pliant.solver.tracks.noise import RAYLEIGH_MEDIAN

STARTS = 8
"""Anchors whose images are nearest to the tracks of a point, of which the one with the least loss is the start."""

LENIENT = 3.0
"""ε of the loss log(1 + (d/ε)²), in robust standard deviations."""

ITERATIONS, SETTLED = 20, 1e-3
"""Maximum number of Gauss–Newton steps per point, and the step, in standard deviations of the template, below which a point stays."""


@dataclass(frozen=True, slots=True, eq=False)
class TemplateMap:
    """Map from the template of a surface to space and to the image, in every frame."""

    template: Floats
    """Template positions of the anchors, shape `(A, 2)`."""

    coefficients: Floats
    """Of the splines to space, shape `(A + 3, F, 3)`."""

    focal: float
    """Focal length, pixels."""

    centre: Floats
    """Principal point, shape `(2,)`, pixels."""

    nearest: float
    """Minimum depth of a point."""

    @classmethod
    def of(cls, template: Floats, anchors: Floats, focal: float, centre: Floats) -> TemplateMap:
        """Return the map through anchors `(F, A, 3)`, camera axes."""
        flat = anchors.transpose(1, 0, 2).reshape(len(template), -1)
        coefficients = spline_coefficients(template, flat).reshape(-1, len(anchors), 3)
        return cls(template, coefficients, focal, centre, 1e-3 * float(np.median(anchors[..., 2])))

    def space(self, places: Floats) -> Floats:
        """Return the positions in camera axes, `(F, M, 3)`, of template positions `(M, 2)`."""
        flat = spline_basis(places, self.template) @ self.coefficients.reshape(len(self.coefficients), -1)
        found = flat.reshape(len(places), -1, 3).transpose(1, 0, 2).copy()
        found[..., 2] = np.maximum(found[..., 2], self.nearest)
        return found

    def image(self, space: Floats) -> Floats:
        """Return the images, pixels, of positions in camera axes."""
        return np.asarray(self.focal * space[..., :2] / space[..., 2:] + self.centre)

    def moved_image(self, places: Floats) -> tuple[Floats, Floats]:
        """Return the images `(F, M, 2)` of template positions `(M, 2)`, and their derivatives `(2, F, M, 2)` by both coordinates."""
        space, flat = self.space(places), self.coefficients.reshape(len(self.coefficients), -1)
        slopes = (spline_slopes(places, self.template) @ flat).reshape(2, len(places), -1, 3).transpose(0, 2, 1, 3)
        along = self.focal * (slopes[..., :2] - space[..., :2] / space[..., 2:] * slopes[..., 2:]) / space[..., 2:]
        return self.image(space), along


def places_of(surface: TemplateMap, tracks: Floats, sure: Floats, images: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return template positions `(P, 2)`; NaN for points that no frame shows, or that lie far outside the template.

    Parameters
    ----------
    surface : TemplateMap
        Of F frames.
    tracks : array, shape (F, P, 2)
        Image positions, pixels.
    sure : array, shape (F, P)
        Roots of their confidences; 0 where hidden.
    images : array, shape (F, A, 2)
        Image positions of the anchors, pixels.
    known : array of bool, shape (F, A)
        Mask of the known ones.
    """
    found = np.full((tracks.shape[1], 2), np.nan)
    together = max(1, CHUNK_OBSERVATIONS // len(tracks))
    for first in range(0, len(found), together):
        some = slice(first, first + together)
        seen = (sure[:, some] > 0).astype(np.float64)
        begun = surface.template[_nearest(tracks[:, some], seen, images, known.astype(np.float64))]
        found[some] = _settled(surface, begun, tracks[:, some], sure[:, some])
        found[some][~seen.any(axis=0)] = np.nan
    # A point that lies beyond the anchors by more than the template's width is not on the surface.
    inside = np.abs(found).max(axis=1, keepdims=True) <= 3 * np.abs(surface.template).max()
    return np.where(inside, found, np.nan)


def _nearest(tracks: Floats, seen: Floats, images: Floats, known: Floats) -> Indices:
    """Return the index of the anchor to whose images the tracks `(F, M, 2)` are nearest, shape `(M,)`.

    Outliers determine sums of squares, which are fast to compute; a robust loss decides between the least of these.
    """
    square = _apart(tracks, seen, images, known)
    some = np.argsort(square, axis=1, kind="stable")[:, :STARTS]
    far = [seen * known[:, each] * np.linalg.norm(tracks - images[:, each], axis=2) for each in some.T]
    shared = [np.maximum((seen * known[:, each]).sum(axis=0), 1) for each in some.T]
    ease = _ease(far[0][seen > 0])
    losses = np.stack([_loss(each, ease) / count for each, count in zip(far, shared, strict=True)], axis=1)
    losses[~np.isfinite(np.take_along_axis(square, some, axis=1))] = np.inf
    return np.take_along_axis(some, losses.argmin(axis=1)[:, None], axis=1)[:, 0]


def _apart(tracks: Floats, seen: Floats, images: Floats, known: Floats) -> Floats:
    """Return the mean squared distances `(M, A)` of tracks from the images of anchors; infinite without a common frame."""
    count = seen.T @ known
    square = (np.square(tracks).sum(axis=2) * seen).T @ known + seen.T @ (np.square(images).sum(axis=2) * known)
    for axis in (0, 1):
        square -= 2 * (tracks[..., axis] * seen).T @ (images[..., axis] * known)
    return np.where(count > 0, square / np.maximum(count, 1), np.inf)


def _settled(surface: TemplateMap, places: Floats, tracks: Floats, sure: Floats) -> Floats:
    """Return the template positions `(M, 2)` whose images are nearest to the tracks, from the given ones.

    Minimises Σ_f log(1 + c_f d_f²/ε²), with confidences c and distances d, by Gauss–Newton steps with Levenberg–Marquardt damping. ε is
    `LENIENT` robust standard deviations of the distances of all points, which decrease with the steps: tracks that contradict the others
    lose their influence. A sum of distances is not robust enough: of few tracks, nearly half may be wrong.
    """
    damping, moving = np.full(len(places), 1e-3), np.ones(len(places), dtype=bool)
    seen = sure > 0
    for _ in range(ITERATIONS):
        pulse()
        image, along = surface.moved_image(places)
        left = tracks - image
        far = sure * np.linalg.norm(left, axis=2)
        ease = _ease(far[seen])
        weight = np.square(sure) / (ease**2 + np.square(far))
        normal = np.einsum("fm,afmc,bfmc->mab", weight, along, along, optimize=True)
        gradient = np.einsum("fm,afmc,fmc->ma", weight, along, left, optimize=True)
        diagonal = np.einsum("maa->ma", normal)
        diagonal += damping[:, None] * diagonal + 1e-12 * float(diagonal.max(initial=np.finfo(np.float64).tiny))
        trial = places + np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        after = sure * np.linalg.norm(tracks - surface.image(surface.space(trial)), axis=2)
        better = moving & (_loss(after, ease) < _loss(far, ease))
        moving &= np.where(better, np.linalg.norm(trial - places, axis=1) > SETTLED, damping < MOST_DAMPED)
        damping *= np.where(better, 0.1, 10.0)
        places = np.where(better[:, None], trial, places)
        if not moving.any():
            break
    return places


def _ease(far: Floats) -> float:
    """Return ε for distances."""
    return max(LENIENT * float(np.median(far)) / RAYLEIGH_MEDIAN, float(np.finfo(np.float32).tiny)) if far.size else 1.0


def _loss(far: Floats, ease: float) -> Floats:
    """Return the sum of the losses over frames, of distances `(F, M)`, shape `(M,)`."""
    return np.asarray(np.log1p(np.square(far / ease)).sum(axis=0))

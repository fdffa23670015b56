"""Extension from anchors to all points, by a flat template of the surface and thin-plate splines over it.

The template flattens the graph of edge lengths (Isomap: shortest paths, then classical scaling; Tenenbaum, de Silva and Langford 2000).
Splines through the anchors map the template to space (`isometry.placement`), in every frame and for all points, including hidden ones. The
image of a visible point is the mean of its track and the spline's image, weighted by their inverse variances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.isometry.inextensible import Indices
from pliant.solver.isometry.placement import TemplateMap, places_of
from pliant.solver.isometry.splines import spline
from pliant.solver.model.so3 import nearest
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats
from pliant.solver.tracks.noise import RAYLEIGH_MEDIAN
from scipy import sparse
from scipy.sparse.csgraph import shortest_path

MIN_ANCHORS, MIN_WIDTH = 6, 0.3
"""Minimum number of anchors, in total and visible in a frame to use it, and minimum standard deviation of their template positions in
the direction in which they extend least, relative to the template's: anchors on a line do not determine the pose of the surface. A rolled
sheet of 7 × 7 points, one frame of which shows one or two rows: the error of that frame is .06, and .26 to .64 with any width."""

OUTLIER_DEVIATIONS = 8.0
"""Distance from the surface's image, in robust standard deviations, beyond which an observation is an outlier."""

SPLINE_ERROR = 3e-3
"""Floor of that standard deviation, relative to the standard deviation of the image: the accuracy of the splines."""


@dataclass(frozen=True, slots=True, eq=False)
class Extended:
    """Positions of all points in all frames."""

    points: Floats
    """Camera axes, shape `(F, P, 3)`, z away from the camera, the depths' unit."""

    outliers: NDArray[np.bool_]
    """Observations that contradict the surface, shape `(F, P)`."""

    placed: NDArray[np.bool_]
    """Points with a template position, shape `(P,)`; the others are put in the middle of the surface."""

    places: Floats
    """Template positions, shape `(P, 2)`; the middle for points without one."""


def flatten(edges: Indices, lengths: Floats, count: int) -> Floats | None:
    """Return template positions `(A, 2)` with standard deviation 1; None if the graph is not connected."""
    used = lengths > 0
    graph = sparse.csr_matrix((lengths[used], (edges[used, 0], edges[used, 1])), shape=(count, count))
    paths = shortest_path(graph, directed=False)
    if not np.isfinite(paths).all():
        return None
    centring = np.eye(count) - 1 / count
    values, vectors = np.linalg.eigh(-0.5 * centring @ np.square(paths) @ centring)
    template = vectors[:, :-3:-1] * np.sqrt(np.maximum(values[:-3:-1], 0.0))
    spread = float(template.std())
    return template / spread if spread > 0 else None


def complete_anchors(points: Floats, seen: NDArray[np.bool_], template: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return anchors `(F, A, 3)` without gaps, and a mask `(F,)` of the frames that show enough of them.

    A hidden anchor is taken from the frame that is most similar after a rigid motion of the common anchors. It is moved by that motion,
    and by a spline over the template that interpolates the remaining differences. A frame that shows too few anchors copies all of them
    from the nearest frame that shows enough.
    """
    filled, enough = points.copy(), np.ones(len(points), dtype=bool)
    shown = np.where(seen[..., None], points, 0.0)
    by_anchor, squares = shown.transpose(1, 0, 2).reshape(seen.shape[1], -1), np.square(shown).sum(axis=2)
    for frame in np.flatnonzero(~seen.all(axis=1)):
        pulse()
        missing = ~seen[frame]
        for other in _alike(by_anchor, squares, seen, int(frame)):
            both, gained = seen[frame] & seen[other], missing & seen[other]
            if gained.any() and _enough(template, both):
                moved = _moved(points[other], points[frame], both)
                left = spline(template[both], (points[frame] - moved)[both], template[gained])
                filled[frame, gained] = moved[gained] + left
                missing &= ~gained
            if not missing.any():
                break
        enough[frame] = _enough(template, seen[frame])
        if missing.any() and enough[frame]:
            filled[frame, missing] = spline(template[~missing], filled[frame, ~missing], template[missing])
    usable = np.flatnonzero(enough)
    for frame in np.flatnonzero(~enough) if len(usable) else ():
        filled[frame] = filled[usable[np.abs(usable - frame).argmin()]]
    return filled, enough


def extend(
    tracks: Floats, confidence: Floats, *, images: Floats, known: NDArray[np.bool_], anchors: Floats,
    template: Floats, focal: float, centre: Floats, noise_std: float,
) -> Extended:  # fmt: skip
    """Return the positions of all points in all frames.

    Parameters
    ----------
    tracks : array, shape (F, P, 2)
        Image positions, pixels.
    confidence : array, shape (F, P)
        Inverse variances of the observations, relative to the maximum; 0 where hidden.
    images : array, shape (F, A, 2)
        Image positions of the anchors, pixels.
    known : array of bool, shape (F, A)
        Mask of the visible ones.
    anchors : array, shape (F, A, 3)
        Anchors in camera axes, without gaps.
    template : array, shape (A, 2)
        Template positions of the anchors, see `flatten`.
    focal : float
        Focal length, pixels.
    centre : array, shape (2,)
        Principal point, pixels.
    noise_std : float
        Standard deviation of observations of full confidence, pixels; 0 if it is unknown, for points that lie where the tracks show them.
    """
    seen, sure = confidence > 0, np.sqrt(confidence)
    surface = TemplateMap.of(template, anchors, focal, centre)
    place = places_of(surface, tracks, sure, images, known)
    placed: NDArray[np.bool_] = np.asarray(np.isfinite(place).all(axis=1))
    places = np.where(placed[:, None], place, 0.0)
    space = surface.space(places)
    image = surface.image(space)
    off = sure * np.linalg.norm(image - tracks, axis=2)
    compared = seen & placed
    limit = OUTLIER_DEVIATIONS * max(
        float(np.median(off[compared])) / RAYLEIGH_MEDIAN, SPLINE_ERROR * _deviation(images, known)
    )
    outliers: NDArray[np.bool_] = np.asarray(compared & (off > limit))
    own = compared & ~outliers
    tracks = image + share_of_track(off[own], confidence, noise_std)[..., None] * (tracks - image)
    rays = np.concatenate([(tracks - centre) / focal, np.ones((*seen.shape, 1))], axis=2)
    return Extended(np.where(own[..., None], rays * space[..., 2:], space), outliers, placed, places)


def share_of_track(off: Floats, confidence: Floats, noise_std: float) -> Floats:
    """Return the weight of every track, `(F, P)`, in its mean with the surface's image, both weighted by their inverse variances.

    `off` are distances between the two, times the roots of the confidences: their variance is that of the noise and of the surface's image.
    """
    noise = noise_std**2
    surface = max((float(np.median(off)) / RAYLEIGH_MEDIAN) ** 2 - noise, 0.0) if off.size else 0.0
    total = confidence * surface + noise
    return np.divide(confidence * surface, total, out=np.ones_like(total), where=total > 0)


def _deviation(images: Floats, known: NDArray[np.bool_]) -> float:
    """Return the standard deviation per coordinate of the anchors' images `(F, A, 2)` about the mean of their frame."""
    count = np.maximum(known.sum(axis=1), 1)[:, None, None]
    mean = np.where(known[..., None], images, 0.0).sum(axis=1, keepdims=True) / count
    return float((images - mean)[known].std())


def _enough(template: Floats, shown: NDArray[np.bool_]) -> bool:
    """Return whether these anchors determine a pose of the surface: there are enough, and they are not on a line."""
    if shown.sum() < MIN_ANCHORS:
        return False
    return bool(
        np.linalg.svd(template[shown] - template[shown].mean(axis=0), compute_uv=False)[1]
        > MIN_WIDTH * shown.sum() ** 0.5
    )


def _alike(by_anchor: Floats, squares: Floats, seen: NDArray[np.bool_], frame: int) -> Indices:
    """Return the frames that share `MIN_ANCHORS` anchors with a frame, sorted by their distance after a rigid motion.

    `by_anchor` are the positions `(A, 3F)` and `squares` their squared lengths `(F, A)`, 0 where hidden. The distance follows from the
    singular values of the covariance (Kabsch 1976).
    """
    used, own = seen[frame].astype(np.float64), by_anchor[:, 3 * frame : 3 * frame + 3]
    count = seen @ used
    shared = np.maximum(count, 1.0)
    here, there = (used @ by_anchor).reshape(-1, 3), seen @ own  # sums over the common anchors
    products = (own.T @ by_anchor).reshape(3, -1, 3).transpose(1, 0, 2)
    covariance = products - there[:, :, None] * here[:, None] / shared[:, None, None]
    spread = squares @ used + seen @ squares[frame] - (np.square(here) + np.square(there)).sum(axis=1) / shared
    along = np.linalg.svd(covariance, compute_uv=False)
    along[:, 2] *= np.sign(np.linalg.det(covariance))
    distance = (spread - 2 * along.sum(axis=1)) / shared
    usable = np.flatnonzero((count >= MIN_ANCHORS) & (np.arange(len(seen)) != frame))
    return usable[np.argsort(distance[usable], kind="stable")]


def _moved(source: Floats, target: Floats, used: NDArray[np.bool_]) -> Floats:
    """Return `source (A, 3)` after the rigid motion that aligns its `used` points with those of `target`."""
    here, there = source[used].mean(axis=0), target[used].mean(axis=0)
    turn = nearest((target[used] - there).T @ (source[used] - here))
    return np.asarray((source - here) @ turn.T + there)

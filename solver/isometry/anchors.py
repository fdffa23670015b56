"""Anchors of a surface: well-spread points whose image positions are denoised with their neighbours, and the graph that connects them.

A small patch of a surface is nearly rigid, and its image nearly affine in its coordinates: u_fq ≈ M_f b_q + c_f with b_q in R². The factors
are fitted to each anchor's patch by alternating least squares with robust weights. In dense tracks, the patch's prediction replaces the
anchor's track, which averages noise and fills hidden observations. In sparse tracks, the anchor keeps its own observations, except those
that contradict the patch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.isometry.inextensible import Indices
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats
from pliant.solver.tracks.frame_selection import evenly_spread
from pliant.solver.tracks.noise import RAYLEIGH_MEDIAN
from scipy import sparse
from scipy.sparse.csgraph import connected_components

POOL = 1800
"""Maximum number of often visible points from which anchors and patches are drawn; bounds time and memory."""

VIEWS = 24
"""Maximum number of frames in which distances between points of the pool are compared."""

PATCH_POINTS = (12, 40)
"""Minimum and maximum number of points of a patch, including the anchor."""

DENSE = 8
"""Minimum number of pool points per anchor for the patch's prediction to replace the anchor's track."""

SWEEPS = 16
"""Alternations of a patch's factors. In the k-th, the scale of the robust weights is at least `ANNEALED`ᵏ patch radii, so that a few
distant observations do not determine which of the others count."""

ANNEALED = 0.6

GROSS = 8.0
"""Distance from the patch, in robust standard deviations, beyond which an observation is rejected."""

FAITHFUL = 0.6
"""Minimum share of an anchor's frames in which its track agrees with its patch; other points cannot be anchors."""

RANK = 2
"""Coordinates of a patch. A third one for curvature would fit outliers, which vary more than patches bend."""

RIDGE = 1e-6
"""Ridge on the patches' normal equations, relative to their mean diagonal."""

NEIGHBOURS = 15
"""k of the graph of nearest neighbours; Chhatkuli et al. (2018) use 10 to 20."""

LARGEST_QUANTILE = 0.9
"""Quantile over frames used as the largest image distance of two points, so that a few outliers do not separate neighbours."""


@dataclass(frozen=True, slots=True, eq=False)
class Anchors:
    """Well-spread points of a surface."""

    points: Floats
    """Image positions, shape `(F, A, 2)`, the tracks' unit; 0 where hidden."""

    confidence: Floats
    """Inverse variances of the positions, relative to those of full confidence, shape `(F, A)`; 0 where hidden."""

    noise_std: float
    """Robust standard deviation about their patches of tracks of full confidence, the tracks' unit."""

    denoised: bool
    """Whether the positions are predictions of patches, as in dense tracks; otherwise they are those of the tracks."""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Mask of the valid positions, shape `(F, A)`."""
        return self.confidence > 0


def choose_anchors(points: Floats, confidence: Floats, count: int) -> Anchors:
    """Return about `count` anchors.

    Parameters
    ----------
    points : shape (F, P, 2)
        Tracks, any unit.
    confidence : shape (F, P)
        Inverse variances of the observations, relative to the maximum; 0 where hidden.
    count : int
        Requested number of anchors. Fewer are returned if fewer points qualify, possibly none.
    """
    seen = confidence > 0
    pool = _pool(seen)
    views = unlike_frames(points[:, pool], seen[:, pool], VIEWS)
    spread = farthest_points(points[views][:, pool], seen[views][:, pool], min(2 * count, len(pool)))
    share = len(pool) // max(count, 1)
    size = min(max(share, PATCH_POINTS[0]), PATCH_POINTS[1], len(pool))
    apart = _apart(points[views][:, pool], seen[views][:, pool], spread)
    patches = pool[np.argsort(apart, axis=1, kind="stable")[:, :size]]
    patches[:, 0] = pool[spread]
    fitted, fits, noise = _fit_patches(points, confidence, patches)
    own = pool[spread]
    sure = confidence[:, own]
    tested = (sure > 0) & fits
    agrees = tested & (np.sqrt(sure) * np.linalg.norm(points[:, own] - fitted, axis=2) <= GROSS * noise)
    faithful = agrees.sum(axis=0) >= FAITHFUL * tested.sum(axis=0)
    # Predictions of patches average many observations, so that their confidences differ little.
    dense = share >= DENSE
    placed, sure = (fitted, fits.astype(np.float64)) if dense else (points[:, own], sure * (agrees | ~fits))
    known = sure > 0
    enough = known.sum(axis=0)
    good = np.flatnonzero(faithful & (2 * enough >= enough.max()) & (enough >= 2))
    if len(good) == 0:
        return Anchors(np.zeros((len(points), 0, 2)), np.zeros((len(points), 0)), noise, dense)
    kept = good[farthest_points(placed[:, good], known[:, good], min(count, len(good)))]
    return Anchors(np.where(known[:, kept, None], placed[:, kept], 0.0), sure[:, kept], noise, dense)


def nearest_neighbours(points: Floats, seen: NDArray[np.bool_], *, neighbours: int = NEIGHBOURS) -> Indices:
    """Return edges `(E, 2)` from every anchor to the anchors that stay nearest to it over all frames.

    `points (F, A, 2)` are their image positions, `seen (F, A)` is the mask of the valid ones.
    """
    count = points.shape[1]
    apart = _apart(points, seen, np.arange(count), quantile=LARGEST_QUANTILE)
    together = seen.T.astype(np.float64) @ seen
    apart[together < 2] = np.inf
    np.fill_diagonal(apart, np.inf)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, : min(neighbours, count - 1)]
    own = np.repeat(np.arange(count), nearest.shape[1])
    usable = np.isfinite(apart[own, nearest.ravel()])
    both = np.sort(np.stack([own, nearest.ravel()], axis=1)[usable], axis=1)
    return np.unique(both, axis=0).reshape(-1, 2)


def connected(seen: NDArray[np.bool_], edges: Indices) -> NDArray[np.bool_]:
    """Return `seen (F, A)` restricted to each frame's largest connected component of visible anchors."""
    kept = np.zeros_like(seen)
    count = seen.shape[1]
    for frame, mask in enumerate(seen):
        used = edges[mask[edges[:, 0]] & mask[edges[:, 1]]]
        graph = sparse.csr_matrix((np.ones(len(used)), (used[:, 0], used[:, 1])), shape=(count, count))
        label = connected_components(graph, directed=False)[1]
        sizes = np.bincount(label[mask], minlength=count)
        kept[frame] = mask & (label == sizes.argmax()) & (sizes.max() >= 2)
    return kept


def farthest_points(points: Floats, seen: NDArray[np.bool_], count: int) -> Indices:
    """Return the indices of `count` points by farthest-point sampling, with the median over frames of the image distance."""
    weight = seen[..., None]
    middle = (points * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
    off = np.where(seen, np.linalg.norm(points - middle[:, None], axis=2), np.nan)
    chosen = [int(np.argmin(_over_frames(off, 0.5)))]
    nearest = np.full(points.shape[1], np.inf)
    while len(chosen) < count:
        apart = _apart(points, seen, np.array(chosen[-1:]))[0]
        nearest = np.minimum(nearest, apart)
        nearest[chosen] = -1.0
        chosen.append(int(np.argmax(np.where(np.isfinite(nearest), nearest, 0.0))))
    return np.array(chosen)


def _pool(seen: NDArray[np.bool_]) -> Indices:
    """Return at most `POOL` points, evenly spread over those visible at least half as often as the most visible one."""
    often = seen.sum(axis=0)
    usable = np.flatnonzero(2 * often >= often.max())
    return np.asarray(usable[evenly_spread(len(usable), POOL)])


def unlike_frames(points: Floats, seen: NDArray[np.bool_], count: int) -> Indices:
    """Return up to `count` dissimilar frames by farthest-point sampling, starting with the frame nearest to the mean image.

    Parameters
    ----------
    points : shape (F, N, 2)
        Image positions; each frame's mean is subtracted first.
    seen : shape (F, N)
        Mask of the visible positions.
    count : int
        Maximum number of frames.
    """
    frames = len(points)
    if frames <= count:
        return np.arange(frames)
    centred = _centred(points, seen)
    weight = seen.astype(np.float64)
    total = np.maximum(weight.sum(axis=0), 1.0)
    mean = (centred * weight[..., None]).sum(axis=0) / total[:, None]

    def unlike(other: Floats, with_weight: Floats) -> Floats:
        both = weight * with_weight
        off = np.linalg.norm(centred - other, axis=2)
        return np.asarray((off * both).sum(axis=1) / np.maximum(both.sum(axis=1), 1e-9))

    chosen = [int(unlike(mean, np.ones(len(mean))).argmin())]
    nearest = np.full(frames, np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, unlike(centred[chosen[-1]], weight[chosen[-1]]))
        nearest[chosen] = -1.0
        chosen.append(int(nearest.argmax()))
    return np.array(chosen)


def _centred(points: Floats, seen: NDArray[np.bool_]) -> Floats:
    weight = seen[..., None]
    middle = (points * weight).sum(axis=1, keepdims=True) / np.maximum(weight.sum(axis=1, keepdims=True), 1)
    return np.where(weight, points - middle, 0.0)


def _apart(points: Floats, seen: NDArray[np.bool_], some: Indices, *, quantile: float = 0.5) -> Floats:
    """Return a quantile over frames of the image distances from the points `some` to all, `(S, N)`; infinite without a common frame."""
    found = np.zeros((len(some), points.shape[1]))
    for row, one in zip(found, some, strict=True):  # all at once would take a quarter of a gigabyte
        distance = np.linalg.norm(points[:, one, None] - points, axis=2)
        row[:] = _over_frames(np.where(seen[:, one, None] & seen, distance, np.nan), quantile)
    return found


def _over_frames(values: Floats, quantile: float) -> Floats:
    """Return the nearest-rank quantile over the first axis, ignoring NaN; infinite where all are NaN."""
    ordered = np.sort(values, axis=0)  # NaN last
    counted = np.isfinite(values).sum(axis=0)
    rank = np.maximum(np.ceil(quantile * counted).astype(int) - 1, 0)
    return np.where(counted > 0, np.take_along_axis(ordered, rank[None], axis=0)[0], np.inf)


def _fit_patches(points: Floats, confidence: Floats, patches: Indices) -> tuple[Floats, NDArray[np.bool_], float]:
    """Return the positions `(F, N, 2)` that N patches `(N, q)` predict for their first points, a mask of reliable ones, and the noise."""
    image = points[:, patches].transpose(1, 0, 2, 3)
    sure = confidence[:, patches].transpose(1, 0, 2)
    known = sure > 0
    middle = _middle(image, known)
    image = np.where(known[..., None], image - middle, 0.0)
    radius = np.linalg.norm(image, axis=3)
    size = float(np.median(radius[known])) or float(radius.max()) or 1.0  # the median is 0 if most points coincide
    shape, weight = _starting_shapes(image, radius, size), sure / (1 + (radius / (3 * size)) ** 2) ** 2
    for sweep in range(SWEEPS):
        pulse()
        inner, shift = _fit_motion(shape, weight, image)
        shape = _fit_shapes(inner, weight, image - shift[:, :, None])
        off = np.linalg.norm(np.einsum("nqa,nfac->nfqc", shape, inner) + shift[:, :, None] - image, axis=3)
        off *= np.sqrt(sure)
        noise = max(float(np.median(off[known])) / RAYLEIGH_MEDIAN, 1e-6 * float(size))
        scale = max(noise, ANNEALED ** (sweep + 1) * float(size))
        weight = sure / (1 + (off / (3 * scale)) ** 2) ** 2
    place = np.einsum("na,nfac->nfc", shape[:, 0], inner) + shift + middle[:, :, 0]
    fits = (known & (off <= GROSS * noise)).sum(axis=2)
    trusted = (fits >= RANK + 3) & (2 * fits >= known.sum(axis=2))
    return place.transpose(1, 0, 2), trusted.T, noise


def _starting_shapes(image: Floats, radius: Floats, size: float) -> Floats:
    """Return starting coordinates `(N, q, 2)` of patches from their centred images `(N, F, q, 2)`, clipped at 3 radii."""
    clipped = image * np.minimum(1.0, 3 * size / np.maximum(radius, 1e-12 * max(size, 1e-300)))[..., None]
    count = image.shape[2]
    stacked = clipped.transpose(0, 1, 3, 2).reshape(len(image), -1, count)
    right = np.linalg.svd(stacked, full_matrices=False)[2][:, :RANK]
    return np.asarray(right.transpose(0, 2, 1) * np.sqrt(count))


def _fit_motion(shape: Floats, weight: Floats, image: Floats) -> tuple[Floats, Floats]:
    """Return M, shape `(N, F, 2, 2)`, and c, shape `(N, F, 2)`, of every patch and frame."""
    basis = np.concatenate([shape, np.ones((*shape.shape[:2], 1))], axis=2)
    motion = _least_squares(
        np.einsum("nfq,nqa,nqb->nfab", weight, basis, basis, optimize=True),
        np.einsum("nfq,nqa,nfqc->nfac", weight, basis, image, optimize=True),
    )
    return motion[:, :, :RANK], motion[:, :, RANK]


def _fit_shapes(inner: Floats, weight: Floats, image: Floats) -> Floats:
    """Return the coordinates b, shape `(N, q, 2)`, for given M and images minus c."""
    return _least_squares(
        np.einsum("nfq,nfac,nfbc->nqab", weight, inner, inner, optimize=True),
        np.einsum("nfq,nfac,nfqc->nqa", weight, inner, image, optimize=True)[..., None],
    )[..., 0]


def _middle(image: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return the median position of every patch in every frame, `(N, F, 1, 2)`; 0 where no point is visible."""
    masked = np.where(known[..., None], image, np.nan)
    found = _over_frames(np.moveaxis(masked, 2, 0), 0.5)[:, :, None]
    return np.where(np.isfinite(found), found, 0.0)


def _least_squares(normal: Floats, right: Floats) -> Floats:
    """Solve stacked normal equations with a small ridge."""
    size = normal.shape[-1]
    ridge = RIDGE * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] / size + 1e-12
    return np.asarray(np.linalg.solve(normal + ridge * np.eye(size), right))

"""Anchors of a surface: some well-spread points whose image positions are cleaned by their neighbours, and the graph between them.

A small patch of a surface is nearly rigid, and its image nearly affine in its coordinates: u_fq ≈ M_f b_q + c_f with b_q in R². The factors
are fitted to each anchor's patch by alternating least squares with robust weights. Where the tracks are dense, an anchor takes the place
that the patch gives it, which averages noise and fills hidden observations; where they are sparse, its own observations are kept and those
that contradict the patch are hidden.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.isometry.inextensible import Indices
from pliant.solver.records import Floats
from pliant.solver.tracks.frame_selection import evenly_spread
from scipy import sparse
from scipy.sparse.csgraph import connected_components

POOL = 1800
"""Points, of the well-seen ones, that anchors and patches are taken from; bounds time and memory."""

VIEWS = 24
"""Frames in which distances between points of the pool are compared."""

PATCH_POINTS = (12, 40)
"""Fewest and most points of a patch, the anchor included."""

DENSE = 8
"""Points of the pool for each anchor from which the patch, not the single track, places an anchor."""

SWEEPS = 16
"""Alternations of a patch's factors. The scale of the robust weights is at least `ANNEALED`ᵏ patch radii at the k-th, so that a few
far observations do not decide which of the others count."""

ANNEALED = 0.6

GROSS = 8.0
"""Robust standard deviations from its patch beyond which an observation is hidden."""

FAITHFUL = 0.6
"""Share of its frames in which an anchor's own track must agree with its patch; other points are no anchors."""

RANK = 2
"""Coordinates of a patch. With a third one for its curvature the fit follows outliers instead: they vary more than patches bend."""

RIDGE = 1e-6
"""Regularises the patches' normal equations, as a share of their trace."""

NEIGHBOURS = 15
"""k of the graph of nearest neighbours; 10 to 20 in the paper by Chhatkuli and others."""

LARGEST_QUANTILE = 0.9
"""Quantile over frames that stands for the largest image distance of two points, so that a few wrong ones do not separate neighbours."""


@dataclass(frozen=True, slots=True, eq=False)
class Anchors:
    """Well-spread points of a surface."""

    points: Floats
    """Image positions, shape `(F, A, 2)`, the tracks' unit; 0 where hidden."""

    seen: NDArray[np.bool_]
    """Which positions count, shape `(F, A)`."""

    noise_std: float
    """Robust standard deviation of single tracks about their patches, the tracks' unit."""


def choose_anchors(points: Floats, seen: NDArray[np.bool_], count: int) -> Anchors:
    """Return about `count` anchors.

    Parameters
    ----------
    points : shape (F, P, 2)
        Tracks, any unit.
    seen : shape (F, P)
        Which observations there are.
    count : int
        Anchors wanted; fewer where there are fewer points, none where none is seen often enough.
    """
    pool = _pool(seen)
    views = unlike_frames(points[:, pool], seen[:, pool], VIEWS)
    spread = farthest_points(points[views][:, pool], seen[views][:, pool], min(2 * count, len(pool)))
    share = len(pool) // max(count, 1)
    size = min(max(share, PATCH_POINTS[0]), PATCH_POINTS[1], len(pool))
    apart = _apart(points[views][:, pool], seen[views][:, pool], spread)
    patches = pool[np.argsort(apart, axis=1, kind="stable")[:, :size]]
    patches[:, 0] = pool[spread]
    fitted, fits, noise = _fit_patches(points, seen, patches)
    own = pool[spread]
    tested = seen[:, own] & fits
    agrees = tested & (np.linalg.norm(points[:, own] - fitted, axis=2) <= GROSS * noise)
    faithful = agrees.sum(axis=0) >= FAITHFUL * tested.sum(axis=0)
    placed, known = (fitted, fits) if share >= DENSE else (points[:, own], seen[:, own] & (agrees | ~fits))
    enough = known.sum(axis=0)
    good = np.flatnonzero(faithful & (2 * enough >= enough.max()) & (enough >= 2))
    if len(good) == 0:
        return Anchors(np.zeros((len(points), 0, 2)), np.zeros((len(points), 0), dtype=bool), noise)
    kept = good[farthest_points(placed[:, good], known[:, good], min(count, len(good)))]
    return Anchors(np.where(known[:, kept, None], placed[:, kept], 0.0), known[:, kept], noise)


def nearest_neighbours(anchors: Anchors, *, neighbours: int = NEIGHBOURS) -> Indices:
    """Return edges `(E, 2)` from every anchor to those whose largest image distance over frames is least."""
    count = anchors.points.shape[1]
    apart = _apart(anchors.points, anchors.seen, np.arange(count), quantile=LARGEST_QUANTILE)
    together = anchors.seen.T.astype(np.float64) @ anchors.seen
    apart[together < 2] = np.inf
    np.fill_diagonal(apart, np.inf)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, : min(neighbours, count - 1)]
    own = np.repeat(np.arange(count), nearest.shape[1])
    usable = np.isfinite(apart[own, nearest.ravel()])
    both = np.sort(np.stack([own, nearest.ravel()], axis=1)[usable], axis=1)
    return np.unique(both, axis=0).reshape(-1, 2)


def connected(seen: NDArray[np.bool_], edges: Indices) -> NDArray[np.bool_]:
    """Return `seen (F, A)` without what, in a frame, no path of seen neighbours joins to the frame's largest part."""
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
    """Return the indices of `count` points, each as far as possible from those before it in the median frame."""
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
    """Return at most `POOL` points, evenly among those seen at least half as often as the one seen most."""
    often = seen.sum(axis=0)
    usable = np.flatnonzero(2 * often >= often.max())
    return np.asarray(usable[evenly_spread(len(usable), POOL)])


def unlike_frames(points: Floats, seen: NDArray[np.bool_], count: int) -> Indices:
    """Return up to `count` frames, first the one nearest to the mean image, then each as unlike as possible to those before it.

    Parameters
    ----------
    points : shape (F, N, 2)
        Image positions; each frame's mean is subtracted first.
    seen : shape (F, N)
        Which of them count.
    count : int
        Frames wanted.
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
    """Return image distances from `some` of the points to all, a quantile over frames, `(S, N)`; infinite if never seen together."""
    distance = np.linalg.norm(points[:, some, None] - points[:, None], axis=3)
    return _over_frames(np.where(seen[:, some, None] & seen[:, None], distance, np.nan), quantile)


def _over_frames(values: Floats, quantile: float) -> Floats:
    """Return the quantile over the first axis without NaN, by the nearest rank; infinite where all are NaN."""
    ordered = np.sort(values, axis=0)  # NaN last
    counted = np.isfinite(values).sum(axis=0)
    rank = np.maximum(np.ceil(quantile * counted).astype(int) - 1, 0)
    return np.where(counted > 0, np.take_along_axis(ordered, rank[None], axis=0)[0], np.inf)


def _fit_patches(points: Floats, seen: NDArray[np.bool_], patches: Indices) -> tuple[Floats, NDArray[np.bool_], float]:
    """Return the places `(F, N, 2)` that N patches `(N, q)` give their first point, where they are trusted, and the noise."""
    image = points[:, patches].transpose(1, 0, 2, 3)
    known = seen[:, patches].transpose(1, 0, 2)
    middle = _middle(image, known)
    image = np.where(known[..., None], image - middle, 0.0)
    radius = np.linalg.norm(image, axis=3)
    size = float(np.median(radius[known])) or float(radius.max()) or 1.0  # most patches may be copies of one point
    clipped = image * np.minimum(1.0, 3 * size / np.maximum(radius, 1e-12 * max(size, 1e-300)))[..., None]
    stacked = clipped.transpose(0, 1, 3, 2).reshape(len(patches), -1, patches.shape[1])
    right = np.linalg.svd(stacked, full_matrices=False)[2][:, :RANK]
    shape, weight = right.transpose(0, 2, 1) * np.sqrt(patches.shape[1]), known / (1 + (radius / (3 * size)) ** 2) ** 2
    noise = float(size)
    motion = np.zeros((len(patches), len(points), RANK + 1, 2))
    for sweep in range(SWEEPS):
        basis = np.concatenate([shape, np.ones((*shape.shape[:2], 1))], axis=2)
        motion = _least_squares(np.einsum("nfq,nqa,nqb->nfab", weight, basis, basis, optimize=True),
                                np.einsum("nfq,nqa,nfqc->nfac", weight, basis, image, optimize=True))  # fmt: skip
        inner, shift = motion[:, :, :RANK], motion[:, :, RANK]
        shape = _least_squares(
            np.einsum("nfq,nfac,nfbc->nqab", weight, inner, inner, optimize=True),
            np.einsum("nfq,nfac,nfqc->nqa", weight, inner, image - shift[:, :, None], optimize=True)[..., None],
        )[..., 0]
        off = np.linalg.norm(np.einsum("nqa,nfac->nfqc", shape, inner) + shift[:, :, None] - image, axis=3)
        noise = max(float(np.median(off[known])) / 1.1774, 1e-6 * float(size))  # median of a Rayleigh variable
        scale = max(noise, ANNEALED ** (sweep + 1) * float(size))
        weight = known / (1 + (off / (3 * scale)) ** 2) ** 2
    place = np.einsum("na,nfac->nfc", shape[:, 0], inner) + shift + middle[:, :, 0]
    fits = (known & (off <= GROSS * noise)).sum(axis=2)
    trusted = (fits >= RANK + 3) & (2 * fits >= known.sum(axis=2))
    return place.transpose(1, 0, 2), trusted.T, noise


def _middle(image: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return the median position of every patch in every frame, `(N, F, 1, 2)`; 0 where nothing is seen."""
    masked = np.where(known[..., None], image, np.nan)
    found = _over_frames(np.moveaxis(masked, 2, 0), 0.5)[:, :, None]
    return np.where(np.isfinite(found), found, 0.0)


def _least_squares(normal: Floats, right: Floats) -> Floats:
    """Solve stacked normal equations with a small ridge."""
    size = normal.shape[-1]
    ridge = RIDGE * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] / size + 1e-12
    return np.asarray(np.linalg.solve(normal + ridge * np.eye(size), right))

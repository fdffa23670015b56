"""Normalization: subtract each frame's centroid and divide by the RMS radius, so that all weights are dimensionless."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pliant.solver.errors import InvalidInput
from pliant.solver.pulse import pulse
from pliant.solver.records import Floats, Tracks, read_only
from pliant.solver.tracks.frame_selection import between

MAX_MEDIAN_RADII = 10.0
"""Distance from the frame's median, in median radii, beyond which an observation does not count for centroid and unit."""


@dataclass(frozen=True, slots=True, eq=False)
class Normalized:
    """Centred, dimensionless tracks: `tracks.points = unit · points + centroid` wherever visible."""

    points: Floats
    """Shape `(F, P, 2)`, RMS radius 1; 0 where hidden."""

    visible: Floats
    """Confidence relative to the maximum, shape `(F, P)`, because only ratios count; 0 where hidden."""

    centroid: Floats
    """Mean of each frame's visible points, shape `(F, 2)`, the tracks' unit; interpolated in frames without any."""

    unit: float
    """One normalized unit: RMS radius of the centred tracks, the tracks' unit."""

    full_confidence: float
    """Confidence that counts as 1: the maximum over the tracks."""


def normalize(tracks: Tracks) -> Normalized:
    """Remove the centroid of each frame and divide by the RMS radius of the centred points.

    Both are confidence-weighted means. Observations further than `MAX_MEDIAN_RADII` median radii from their frame's
    median are excluded from the means, because a single one can make the object arbitrarily small. They stay in the
    tracks, where the robust loss handles them.

    Raises
    ------
    InvalidInput
        Every visible point lies at its frame's centroid.
    """
    seen = tracks.visible > 0
    weight = np.where(_near(tracks, seen), tracks.visible, 0.0)
    pulse()
    total = weight.sum(axis=1)
    shown = total > 0
    mean = np.einsum("fp,fpc->fc", weight, tracks.points)
    mean[shown] /= total[shown, None]
    centroid = between(np.flatnonzero(shown), mean[shown], tracks.num_frames)
    points = np.zeros(tracks.points.shape)
    for frame, mask in enumerate(seen):
        pulse()
        points[frame, mask] = tracks.points[frame, mask] - centroid[frame]
    pulse()
    unit = float(np.sqrt(np.einsum("fp,fpc,fpc->", weight, points, points) / total.sum()))
    if not unit > 1e-12 * max(float(np.abs(centroid).max()), np.finfo(float).tiny):
        raise InvalidInput(
            "no_extent", field="tracks", expected="points that differ from each other in a frame",
            got="one position for all visible points of each frame, to within rounding",
            hint="Check that the points' axis is the second one, that the tracks are not all zero, and that frames show several points.",
        )  # fmt: skip
    points /= unit
    read_only(points)
    read_only(centroid)
    full = float(tracks.visible.max())
    return Normalized(points, relative(tracks.visible, full), centroid, unit, full)


def relative(confidence: Floats, full: float) -> Floats:
    """Return `confidence (F, P)` divided by `full`, read-only; unchanged if `full` is 0 or 1."""
    if full in (0, 1):
        return confidence
    shares = confidence / full
    read_only(shares)
    return shares


def _near(tracks: Tracks, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask of the visible observations within `MAX_MEDIAN_RADII` median radii of their frame's median, shape `(F, P)`."""
    near = seen.copy()
    radius = np.zeros(seen.shape)
    for frame, mask in enumerate(seen):
        pulse()
        if mask.any():
            middle = np.median(tracks.points[frame, mask], axis=0)
            radius[frame] = np.hypot(*(tracks.points[frame] - middle).T)
    pulse()
    typical = _median(radius[seen])
    if typical == 0:  # as where most frames show a single point
        return seen
    near &= radius <= MAX_MEDIAN_RADII * typical
    return near


def _median(values: Floats) -> float:
    """Return the median of finite `values (N,)`, reordering them; for 40 million, `np.median` takes three times as long."""
    lower, upper = (values.size - 1) // 2, values.size // 2
    values.partition((lower, upper))
    return float((values[lower] + values[upper]) / 2)

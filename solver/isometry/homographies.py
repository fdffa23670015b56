"""Distance of the tracks from images of a plane, seen by a perspective camera.

A homography relates any two images of a plane, for any distance and rotation of the camera (Hartley and Zisserman, *Multiple View Geometry
in Computer Vision*, 2004, chapter 13). The singular values of the tracks reveal a plane only if the camera is distant.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pliant.solver.records import Floats

FEWEST_COMMON = 8
"""Minimum number of common anchors of two frames; a homography has eight parameters, which four points determine."""


def off_homography(points: Floats, seen: NDArray[np.bool_]) -> float:
    """Return the distance of the frames from homographies of a reference frame, relative to the object's size in the image.

    `points (F, A, 2)` are image positions, `seen (F, A)` is the mask of the valid ones.

    The median over the other frames of the median distance of the anchors, minimised over the reference frame; infinite if no two frames
    share `FEWEST_COMMON` anchors.
    """
    frames = range(len(seen))
    least = np.inf
    for one in frames:
        common = [(other, seen[one] & seen[other]) for other in frames if other != one]
        found = [
            unlike_homography(points[one, both], points[other, both])
            for other, both in common
            if both.sum() >= FEWEST_COMMON
        ]
        if found:
            least = min(least, float(np.median(found)))
    return least


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def unlike_homography(points: Floats, others: Floats) -> float:
    """Return the median distance between `others (N, 2)` and the image of `points (N, 2)` under the best homography.

    The normalized direct linear transform gives the homography. The unit is the RMS distance of `others` from their mean; points mapped
    to infinity count as infinitely far.
    """
    ours, theirs = _normalized(points), _normalized(others)
    one, none = np.ones((len(ours), 1)), np.zeros((len(ours), 3))
    wide = np.hstack([ours, one])
    system = np.vstack([np.hstack([wide, none, -theirs[:, :1] * wide]), np.hstack([none, wide, -theirs[:, 1:] * wide])])
    homography = np.linalg.svd(system)[2][-1].reshape(3, 3)
    sent = wide @ homography.T
    apart = np.linalg.norm(sent[:, :2] / sent[:, 2:] - theirs, axis=1)
    return float(np.median(np.where(np.isfinite(apart), apart, np.inf)))


def _normalized(points: Floats) -> Floats:
    centred = points - points.mean(axis=0)
    return np.asarray(centred / max(float(np.sqrt(np.square(centred).sum(axis=1).mean())), np.finfo(np.float64).tiny))

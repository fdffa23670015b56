"""How nearly the tracks are those of a plane, seen by a perspective camera.

Two pictures of a plane are related by a homography, however near the camera is and however far it turns (Hartley and Zisserman, *Multiple
View Geometry in Computer Vision*, 2004, chapter 13). The singular values of the tracks are those of a plane only for a distant camera.
"""

from __future__ import annotations

import numpy as np
from pliant.solver.isometry.anchors import Anchors
from pliant.solver.records import Floats

FEWEST_COMMON = 8
"""Anchors that two frames must share; a homography has eight parameters, and four points determine it."""


def off_homography(anchors: Anchors) -> float:
    """Return by how much the pictures differ from homographies of one of them, share of the size of the object in the picture.

    The median over the other frames of the median distance of the anchors, for the picture for which it is least; infinite where no two
    frames share `FEWEST_COMMON` anchors.
    """
    frames = range(len(anchors.seen))
    least = np.inf
    for one in frames:
        common = [(other, anchors.seen[one] & anchors.seen[other]) for other in frames if other != one]
        found = [
            unlike_homography(anchors.points[one, both], anchors.points[other, both])
            for other, both in common
            if both.sum() >= FEWEST_COMMON
        ]
        if found:
            least = min(least, float(np.median(found)))
    return least


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def unlike_homography(points: Floats, others: Floats) -> float:
    """Return the median distance of points `(N, 2)`, after a homography, from the others, `(N, 2)`.

    The homography is that of the normalized direct linear transform, the unit the root mean square distance of the others from their
    mean; infinite where points are sent to infinity.
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

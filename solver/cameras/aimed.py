"""Images as seen by cameras that are turned towards the object.

A scaled-orthographic camera sees an object as if the ray to it were the optical axis. If the object moves through the picture of a pinhole
camera, the rotations of the two differ by the angle of that ray, and an error of a depth moves a point by κ times its distance from the
principal point. Turning a pinhole camera about its centre changes the image by a homography that depends only on κ, so cameras can be
estimated from images that are turned towards the object, and then turned back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pliant.solver.cameras.perspective import DepthMap, depth_map
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.records import Floats

STEP = 1e-5
"""Half of the interval of κ, inverse normalized units, for the derivative of the images: about the cube root of the rounding error, which
balances it against the error of the difference quotient."""


@dataclass(frozen=True, slots=True, eq=False)
class Aimed:
    """Images `(F, P, 2)` of cameras turned towards the mean image point of each frame.

    The images are divided by cos θ, with θ the angle of the turn, so that their scale, φ over the distance along the original axis, stays
    that of the original images. Their perspective is therefore that of κ cos θ.
    """

    views: Floats
    """Shape `(F, P, 2)`, relative to the new principal point."""

    turns: Floats
    """Rotations `(F, 3, 3)` from the original to the turned cameras."""

    density: float
    """What the change of variables adds to the negative log likelihood per point and frame."""

    @classmethod
    def of(cls, views: Floats, inverse_focal: float) -> Aimed:
        """Turn the cameras of images `(F, P, 2)`, relative to the principal point, in units where the focal length is 1/κ.

        Raises
        ------
        numpy.linalg.LinAlgError
            With this κ, some points of the object lie behind a turned camera.
        """
        middle = views.mean(axis=1)
        turns = towards(middle, inverse_focal)
        cosine = turns[:, 2, 2]
        # For κ = 0 the third column of a turn is 0, and the object moves to the principal point by this difference of image points.
        shifted = views @ turns[:, :2, :2].transpose(0, 2, 1) - (cosine[:, None] * middle)[:, None]
        ahead = inverse_focal * np.einsum("fc,fpc->fp", turns[:, 2, :2], views) + cosine[:, None]
        if not ahead.min() > 0:
            raise np.linalg.LinAlgError("points lie behind a turned camera")
        change = 3 * float(np.log(ahead).mean()) + 2 * float(np.log(cosine).mean())
        return cls(shifted / (ahead * cosine[:, None])[..., None], turns, change)

    @classmethod
    def unturned(cls, views: Floats) -> Aimed:
        """Return the images of cameras that are not turned, such as those with known rotations."""
        return cls(views, np.tile(np.eye(3), (len(views), 1, 1)), 0.0)

    @classmethod
    def with_slopes(cls, views: Floats, inverse_focal: float) -> tuple[Aimed, Floats, float]:
        """Return the turned images, and the derivatives of images and density with respect to κ."""
        before, after = (cls.of(views, inverse_focal + step) for step in (-STEP, STEP))
        slope = (after.views - before.views) / (2 * STEP)
        return cls.of(views, inverse_focal), slope, (after.density - before.density) / (2 * STEP)

    def turned(self, rotations: Floats) -> Floats:
        """Return the rotations of the turned cameras for those of the original cameras, `(F, 3, 3)`."""
        return np.asarray(self.turns @ rotations)

    def depth_map(self, rotations: Floats, scales: Floats, covariance: ShapeCovariance) -> Floats | DepthMap:
        """Return D of the turned cameras, shape `(F, 2F)`, times cos θ, so that κ corrects the tracks as without a turn."""
        depth, cosine = depth_map(rotations, scales, covariance), self.turns[:, 2, 2, None]
        return replace(depth, away=cosine * depth.away) if isinstance(depth, DepthMap) else np.asarray(cosine * depth)


def towards(points: Floats, inverse_focal: float) -> Floats:
    """Return the smallest rotations `(F, 3, 3)` that turn the rays through image points `(F, 2)` onto the optical axis."""
    x, y = inverse_focal * points.T
    z = 1 / np.sqrt(1 + x**2 + y**2)
    x, y = x * z, y * z
    rows = [
        [1 - x * x / (1 + z), -x * y / (1 + z), -x],
        [-x * y / (1 + z), 1 - y * y / (1 + z), -y],
        [x, y, z],
    ]
    return np.array(rows).transpose(2, 0, 1)

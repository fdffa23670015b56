"""The error of estimated cameras."""

from __future__ import annotations

import numpy as np
from pliant.solver.model.so3 import MIRROR, angles_between, nearest


def degrees_apart(found: np.ndarray, truth: np.ndarray) -> float:
    """Return the mean angle in degrees after alignment by one world rotation and the depth mirror."""
    errors = []
    for mirror in (np.eye(3), MIRROR):
        turned = mirror @ found @ mirror
        world = nearest(np.einsum("fji,fjk->ik", turned, truth))
        errors.append(float(np.degrees(angles_between(turned @ world, truth).mean())))
    return min(errors)

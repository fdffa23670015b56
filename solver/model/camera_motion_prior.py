"""How unsteady a camera is: what a real one does not do between two frames.

The tracks of a thing that deforms strongly are explained almost equally well by many camera paths, for turning every frame a
little is a cheap way to explain deformation. What tells them apart is that cameras and bodies have inertia. With T_f = R_{f+1} R_fᵀ
the turn from frame f to the next, T_f − T_{f−1} is the change of angular velocity; its components are taken as Gaussian of
unknown variance, and the negative log-likelihood with the variance at its most likely value is

    3/2 log(floor² + mean_f ½‖T_f − T_{f−1}‖_F²)      for each of the F − 2 changes, divided by F as the energy is,

and ½ log(floor² + mean_f (log s_{f+1} − log s_f)²) for the scales. No strength has to be set: a camera with jumps has a large
variance and is hardly bound, a steady one is held; the floors say from where on more steadiness is worth nothing.
"""

from __future__ import annotations

import numpy as np
from pliant.solver.records import Floats

TURN_FLOOR = np.radians(0.2)
"""Change of the turn from frame to frame, rad, that needs no reason."""

SCALE_FLOOR = 0.002
"""Change of log s from frame to frame that needs no reason."""


def unsteadiness(rotations: Floats) -> tuple[float, Floats]:
    """Return the term for the rotations, shape `(F, 3, 3)`, and its gradient in all nine entries of each."""
    turns = rotations[1:] @ np.swapaxes(rotations[:-1], 1, 2)
    changes = np.diff(turns, axis=0)
    count = max(len(changes), 1)
    variance = TURN_FLOOR**2 + 0.5 * float((changes**2).sum()) / count
    by_turns = np.zeros_like(turns)
    by_turns[1:] += changes
    by_turns[:-1] -= changes
    by_turns *= 1.5 / (variance * len(rotations))
    gradient = np.zeros_like(rotations)
    gradient[1:] += by_turns @ rotations[:-1]
    gradient[:-1] += np.swapaxes(by_turns, 1, 2) @ rotations[1:]
    return 1.5 * count / len(rotations) * float(np.log(variance)), gradient


def unevenness(logs: Floats) -> tuple[float, Floats]:
    """Return the term for the logarithms of the scales, shape `(F,)`, and its gradient."""
    steps = np.diff(logs)
    variance = SCALE_FLOOR**2 + float((steps**2).mean())
    gradient = np.zeros_like(logs)
    gradient[1:] += steps
    gradient[:-1] -= steps
    return 0.5 * float(np.log(variance)), gradient / (variance * len(steps))

"""Prior on camera motion: a penalty on changes of angular velocity and of scale between frames.

Many camera paths explain the tracks of a strongly deforming object almost equally well, because a small rotation of
every frame absorbs deformation. Cameras and bodies have inertia, which separates these paths. With T_f = R_{f+1} R_fᵀ
the rotation from frame f to the next, T_f − T_{f−1} is the change of angular velocity. Its components are Gaussian
with unknown variance; at the most likely variance the negative log likelihood is

    3/2 log(floor² + mean_f ½‖T_f − T_{f−1}‖_F²)

for each of the F − 2 changes, divided by F like the energy. The term for the scales is ½ log(floor² + mean_f (log
s_{f+1} − log s_f)²). The variance is estimated, not tuned: the prior is weak for a jerky camera and strong
for a smooth one. Below the floors, smoother motion is no longer rewarded.
"""

from __future__ import annotations

from math import log

import numpy as np
from pliant.solver.records import Floats

TURN_FLOOR = np.radians(0.2)
"""Floor of the change of rotation between frames, rad: smaller changes are not rewarded."""

SCALE_FLOOR = 0.002
"""Floor of the change of log s between frames: smaller changes are not rewarded."""

STEADY = 0.5 * log(SCALE_FLOOR**2)
"""Penalty on equal scales, added if scales are fixed so that energies with fixed and free scales are comparable."""


def rotation_roughness(rotations: Floats) -> tuple[float, Floats]:
    """Return the penalty on rotations of shape `(F, 3, 3)` and its gradient with respect to all nine entries of each."""
    turns = rotations[1:] @ rotations[:-1].transpose(0, 2, 1)
    changes = turns[1:] - turns[:-1]
    count = max(len(changes), 1)
    variance = TURN_FLOOR**2 + 0.5 * float(np.vdot(changes, changes)) / count
    by_turns = np.zeros(turns.shape)
    by_turns[1:] = changes
    by_turns[:-1] -= changes
    by_turns *= 1.5 / (variance * len(rotations))
    gradient = np.zeros(rotations.shape)
    gradient[1:] = by_turns @ rotations[:-1]
    gradient[:-1] += by_turns.transpose(0, 2, 1) @ rotations[1:]
    return 1.5 * count / len(rotations) * log(variance), gradient


def scale_roughness(logs: Floats) -> tuple[float, Floats]:
    """Return the penalty on the logarithms of the scales, shape `(F,)`, and its gradient."""
    steps = logs[1:] - logs[:-1]
    variance = SCALE_FLOOR**2 + float(np.vdot(steps, steps)) / len(steps)
    gradient = np.zeros(logs.shape)
    gradient[1:] = steps
    gradient[:-1] -= steps
    return 0.5 * log(variance), gradient / (variance * len(steps))

"""The shape covariance of a sequence whose cameras are final."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.model.early_stopping import described, learn_with_early_stopping
from pliant.solver.model.expectation_maximisation import ModelOrder
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.monitor import enter
from pliant.solver.pulse import ShouldStop
from pliant.solver.records import Floats
from pliant.solver.refinement.depth_rounds import with_depth_map


@dataclass(frozen=True, slots=True, eq=False)
class LearningData:
    """Data from which the shape covariance is learned, once the cameras are final."""

    gram: Floats
    """Gram matrix of the frames used, divided by the starting scales, shape `(2F', 2F')`; empty for all frames of a long film."""

    sample: Floats
    """Sampled points, divided by the same scales, shape `(F', S, 2)`."""

    projections: Floats
    """Cameras of the frames used, relative to the same scales, shape `(F', 2, 3)`."""

    used: NDArray[np.intp]
    """Indices of the frames used."""

    model_order: ModelOrder

    covariance: ShapeCovariance | None
    """Already learned, with an interrupted refinement or the cameras of a long film; None to learn one."""

    rotations: Floats
    """Cameras of all frames in the axes of `projections`, shape `(F, 3, 3)`."""

    scales: Floats
    """Scales of all frames, shape `(F,)`."""

    turned: bool
    """Whether the world axes of the estimate are those of its first camera."""


def learn_covariance(
    estimate: CameraEstimate, data: LearningData, *, seed: int = 0, should_stop: ShouldStop
) -> tuple[CameraEstimate, ShapeCovariance]:
    """Return the shape covariance of all frames for fixed cameras, and the estimate with the depths that follow from it.

    Parameters
    ----------
    estimate : CameraEstimate
        The cameras, from `refine_cameras`.
    data : LearningData
        From the same call.
    seed : int
        Seed of the split of the points for held-out scores.
    should_stop : callable
        Called between rounds of EM; once it returns True, the best covariance so far is returned.
    """
    if data.covariance is not None:
        covariance, modes = data.covariance, described(data.covariance)
    else:
        # Learn from scratch: modes learned along the way to these cameras overstate their likelihood.
        enter(should_stop, "covariance")
        covariance, modes = learn_with_early_stopping(
            data.sample, data.gram, data.projections, data.model_order, seed=seed, should_stop=should_stop
        )
    if len(data.used) < len(estimate.rotations):
        covariance = covariance.stretched(data.used, len(estimate.rotations))
    estimate = with_depth_map(
        replace(estimate, reasons={**estimate.reasons, "modes": modes}), covariance, data.rotations, data.scales
    )
    return estimate, covariance.turned(data.rotations[0]) if data.turned else covariance

"""Cameras and covariance in one call, as a solve learns them, and the dense precisions of the prior."""

from __future__ import annotations

from typing import Any

import numpy as np
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.model.shape_covariance import ShapeCovariance
from pliant.solver.operators.gauss_markov import PathPrior
from pliant.solver.pulse import never
from pliant.solver.refinement.covariance_learning import learn_covariance
from pliant.solver.refinement.joint_refinement import refine_cameras
from pliant.solver.tracks.normalization import Normalized


def learn(estimate: CameraEstimate, normalized: Normalized, **more: Any) -> tuple[CameraEstimate, ShapeCovariance]:
    """Return the cameras of `refine_cameras`, learned from every frame, and the covariance of `learn_covariance`."""
    refined, data = refine_cameras(estimate, normalized, np.ones(len(normalized.points), dtype=bool), **more)
    return learn_covariance(refined, data, should_stop=more.get("should_stop", never))


def dense_precisions(prior: PathPrior) -> np.ndarray:
    """Return the precision over frames of each coordinate, shape `(3, F, F)`."""
    diagonal, beside = prior.bands[0], prior.bands[1, :-1]
    chain = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    return np.stack([chain - each @ each.T for each in prior.modes])

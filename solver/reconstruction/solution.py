"""Conversion of the last state of a minimisation to a solution in the tracks' unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.energy.objective import residuals_of
from pliant.solver.energy.problem import Problem
from pliant.solver.energy.robust_loss import largest_weight
from pliant.solver.limits import frame_chunks
from pliant.solver.pulse import pulse
from pliant.solver.records import Camera, Choices, read_only
from pliant.solver.shapes.state import State
from pliant.solver.solution import Outcome, Solution, Trace
from pliant.solver.tracks.normalization import Normalized


def finish(
    problem: Problem,
    history: list[State],
    outcome: Outcome,
    *,
    normalized: Normalized,
    estimate: CameraEstimate,
    choices: Choices,
    y_up: bool,
) -> Solution:
    """Convert the last state to a Solution in the tracks' unit, with orthographic cameras; `y_up` as in the settings."""
    state, unit = history[-1], normalized.unit
    top = largest_weight(problem.loss, problem.weights.robust_scale)
    frames, _, points = state.shapes.shape
    shapes, residual, trust = np.zeros((frames, points, 3)), np.zeros((frames, points)), np.zeros((frames, points))
    for some in frame_chunks(frames, points):
        seen = normalized.visible[some] > 0
        left = np.stack([residuals_of(problem, state.shapes, state.translations, f) for f in range(frames)[some]])
        left = left.astype(np.float64, copy=False)
        residual[some] = unit * np.where(seen, np.hypot(left[:, 0], left[:, 1]), 0.0)
        trust[some] = np.clip(np.where(seen, state.omega[some].mean(axis=1, dtype=np.float64) / top, 0.0), 0.0, 1.0)
        shapes[some] = (state.shapes[some].transpose(0, 2, 1).astype(np.float64) @ problem.axes.T) * unit
    camera = Camera(
        np.array(estimate.rotations, dtype=np.float64),
        np.array(estimate.scales, dtype=np.float64),
        normalized.centroid + unit * state.translations,
        y_up=y_up,
    )
    trace = Trace(
        np.array([s.objective for s in history]),
        unit * np.array([s.residual for s in history]),
        np.array([s.iterations for s in history], dtype=np.int32),
    )
    return Solution(shapes, camera, residual, trust, trace, outcome, choices, {})


def in_world_unit(solution: Solution, world_scale: float) -> Solution:
    """Return the solution with shapes in the unit of given cameras, whose mean scale is `world_scale`; its arrays are changed in place."""
    if world_scale == 1:
        return solution
    for array in (solution.shapes, solution.shapes_std):
        if array is not None:
            array.flags.writeable = True
            for frame in array:
                pulse()
                frame /= world_scale
            read_only(array)
    return replace(solution, camera=replace(solution.camera, scales=solution.camera.scales * world_scale))

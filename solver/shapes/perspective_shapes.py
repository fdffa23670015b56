"""Shapes under perspective: correct the tracks with the estimated depths, and return cameras that project to pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.cameras.perspective import Perspective, corrected_tracks
from pliant.solver.energy.problem import Problem
from pliant.solver.records import Camera, Floats, Tracks
from pliant.solver.shapes.state import State
from pliant.solver.solution import Solution
from pliant.solver.tracks.normalization import Normalized


def corrected_again(
    problem: Problem,
    state: State,
    normalized: Normalized,
    flat: Normalized,
    estimate: CameraEstimate,
    kept: NDArray[np.intp] | None,
) -> tuple[Problem, Normalized, float]:
    """Return problem and tracks corrected with the depths of the state, and the RMS change of the corrected tracks.

    Parameters
    ----------
    problem
        Problem of the points `kept`.
    state
        Its state.
    normalized : Normalized
        The original tracks.
    flat : Normalized
        Their latest correction.
    estimate : CameraEstimate
        κ and the cameras.
    kept : array of int, optional
        Points of the problem, None for all; the others keep their correction.
    """
    view = estimate.perspective
    assert view is not None
    places = np.arange(normalized.points.shape[1]) if kept is None else kept
    rows = estimate.scales[:, None] * estimate.rotations[:, 2] @ problem.axes
    depths = np.einsum("fi,fip->fp", rows, state.shapes.astype(np.float64))
    part = replace(normalized, points=normalized.points[:, places], visible=normalized.visible[:, places])
    points = corrected_tracks(part, view, depths).points
    seen = problem.confidence > 0
    squared = np.square(points - flat.points[:, places]).sum(axis=2)
    changed = float(np.sqrt(squared[seen].mean())) if seen.any() else 0.0
    whole = flat.points.copy()
    whole[:, places] = points
    problem = replace(problem, points=np.ascontiguousarray(points.transpose(0, 2, 1), dtype=problem.points.dtype))
    return problem, replace(flat, points=whole), changed


def seen_in_perspective(
    solution: Solution, tracks: Tracks, view: Perspective, unit: float, kept: NDArray[np.intp] | None
) -> Solution:
    """Return the solution with a camera that projects to the original tracks, and residuals relative to these.

    Tracks were corrected with depths relative to the mean of the points `kept`, but shapes may be centred on the mean of all points. With c
    the difference in depth, 1 + κ(z + c) = (1 + κc)(1 + κz/(1 + κc)), so scales and translations are divided by 1 + κc.
    """
    camera = replace(solution.camera, principal_point=np.array(view.principal_point))
    if not view.is_perspective:
        return replace(solution, camera=camera)
    focal = unit / abs(view.inverse_focal)
    scales, translations = camera.scales, camera.translations
    if kept is not None:
        nearer = 1 - camera.depths(solution.shapes)[:, kept].mean(axis=1) / focal
        scales = scales / nearer
        translations = camera.principal_point + (translations - camera.principal_point) / nearer[:, None]
    camera = Camera(
        camera.rotations, scales, translations, focal, view.focal_std(unit), camera.principal_point, camera.y_up
    )  # fmt: skip
    left = tracks.points - camera.project(solution.shapes)
    residuals: Floats = np.where(tracks.visible > 0, np.hypot(left[..., 0], left[..., 1]), 0.0)
    return replace(solution, camera=camera, residuals=residuals)

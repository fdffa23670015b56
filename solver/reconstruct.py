"""`solve`: cameras, then the prior, then the shapes.

Each stage is also a public function of `pliant.solver`: `estimate_cameras`, `learn_prior`, `find_outliers` and `solve_shapes`. `solve`
composes them and adds two steps: it sorts unordered photographs by content, and, where the settings describe the lens, it first tests
whether the surface is isometric.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pliant.solver.agreement import check_agreement, separate_points_warnings, shared_position_warnings
from pliant.solver.errors import singular_refused
from pliant.solver.mesh import Mesh
from pliant.solver.monitor import Monitor
from pliant.solver.pulse import pulses_to
from pliant.solver.reconstruction.blocks import needs_blocks
from pliant.solver.reconstruction.cameras import cameras_of
from pliant.solver.reconstruction.observations import monitored, observe
from pliant.solver.reconstruction.prior import prior_of
from pliant.solver.reconstruction.solve_shapes import shapes_of
from pliant.solver.reconstruction.surface import isometric_verdict, solution_of, tries_isometry, with_verdict
from pliant.solver.records import KnownCamera, Step, Tracks
from pliant.solver.settings import Settings
from pliant.solver.solution import Solution
from pliant.solver.threads import serial_blas
from pliant.solver.tracks.frame_order import as_they_came, content_order, differences, in_order, resolved_order


def solve(
    tracks: Tracks,
    mesh: Mesh | None = None,
    *,
    cameras: KnownCamera | None = None,
    settings: Settings | None = None,
    on_step: Callable[[Step], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    scratch: str | Path | None = None,
) -> Solution:
    """Reconstruct a 3-D shape for every frame.

    Parameters
    ----------
    tracks : Tracks
        F frames of P points.
    mesh : Mesh, optional
        Defines which points are neighbours; without it the shapes are not smoothed in space.
    cameras : KnownCamera, optional
        Given cameras; None estimates them. Scales that are not given are estimated if the camera model has them.
    settings : Settings, optional
        Method, weights, precision; the defaults suit most sequences.
    on_step : callable, optional
        Called with the progress of the solve, normally at least every half second.
    should_stop : callable, optional
        Called between units of work; once it returns True, the solve ends with `Outcome.STOPPED` and the last shapes.
    scratch : path, optional
        Folder for a temporary file that holds a result of more than 10 million frames times points (`limits.BLOCK_OBSERVATIONS`), which is
        solved in blocks of points; None holds it in memory. The file is deleted with the result.

    Raises
    ------
    InvalidInput
        Mesh or cameras do not fit the tracks, or the tracks have no extent or too few points that are visible in two frames. Tracks and
        cameras that were made without `from_arrays` are validated, too.
    InvalidSettings
        The settings contradict the mesh, the cameras or the number of frames.
    NotFinite
        The arithmetic overflowed, or rounding errors made equations singular.
    OSError
        The folder `scratch` is missing, cannot be written to, or has too little space.
    """
    settings = settings if settings is not None else Settings()
    check_agreement(tracks, mesh, cameras, settings)
    settings, why = resolved_order(tracks, settings)
    sheet = tries_isometry(cameras, settings)
    monitor = monitored(tracks, cameras, settings, on_step, should_stop, sheet=sheet)
    with serial_blas(), pulses_to(monitor.pulse), singular_refused():
        if settings.order == "film":
            return _with_report(_solved(tracks, mesh, cameras, settings, monitor, scratch), tracks, why)
        order = content_order(differences(tracks))
        moved, cameras = in_order(tracks, cameras, order)
        solution = as_they_came(_solved(moved, mesh, cameras, settings, monitor, scratch), order)
        return _with_report(solution, tracks, why)


def _with_report(solution: Solution, tracks: Tracks, why: str) -> Solution:
    """Return the solution with the reason for the order of the frames, and warnings about the tracks."""
    choices = solution.choices
    warnings = (*shared_position_warnings(tracks), *separate_points_warnings(tracks), *choices.warnings)
    return replace(solution, choices=replace(choices, reasons={**choices.reasons, "order": why}, warnings=warnings))


def _solved(
    tracks: Tracks,
    mesh: Mesh | None,
    known: KnownCamera | None,
    settings: Settings,
    monitor: Monitor,
    scratch: str | Path | None,
) -> Solution:
    """Solve the frames in their present order; with `order` `any` no prior compares neighbouring frames."""
    began = time.perf_counter()
    observations = observe(tracks, known, settings)
    verdict = isometric_verdict(tracks, known, settings, monitor)
    if verdict is not None and verdict.surface is not None and not verdict.weak:
        return solution_of(tracks, verdict, settings, monitor, began=began)
    cameras = cameras_of(observations, monitor)
    prior = prior_of(cameras, monitor, seed=settings.seed) if settings.gaussian else None
    monitor.report(Step("cameras", 0.0, max_reweightings=settings.max_reweightings))
    learning = time.perf_counter() - began
    if needs_blocks(tracks, settings):  # which take their points from the tracks
        cameras = replace(cameras, observations=cameras.observations.without_points())
    solution = shapes_of(
        tracks, cameras, prior, mesh, settings, monitor, seconds={"cameras": learning}, scratch=scratch
    )
    return solution if verdict is None else with_verdict(solution, tracks, verdict, settings, monitor, began=began)

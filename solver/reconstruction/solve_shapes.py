"""Public interface of the third stage: shapes for given cameras and prior, at once or in blocks of points."""

from __future__ import annotations

import time
from pathlib import Path

from pliant.solver.agreement import check_mesh, check_tracks
from pliant.solver.errors import singular_refused
from pliant.solver.mesh import Mesh
from pliant.solver.monitor import Monitor
from pliant.solver.pulse import ShouldStop, pulses_to
from pliant.solver.reconstruction.blocks import needs_blocks, shapes_in_blocks
from pliant.solver.reconstruction.cameras import Cameras
from pliant.solver.reconstruction.observations import OnStep, monitored
from pliant.solver.reconstruction.prior import Prior, changes_of
from pliant.solver.reconstruction.shapes import shapes_from
from pliant.solver.reconstruction.solution import in_world_unit
from pliant.solver.reconstruction.start import begin, check_types, start_shapes, without_learned_prior
from pliant.solver.records import Floats, Tracks
from pliant.solver.settings import Settings
from pliant.solver.solution import Solution
from pliant.solver.threads import serial_blas


def solve_shapes(
    tracks: Tracks,
    cameras: Cameras,
    prior: Prior | None = None,
    mesh: Mesh | None = None,
    *,
    settings: Settings | None = None,
    start: Solution | Floats | None = None,
    scratch: str | Path | None = None,
    on_step: OnStep | None = None,
    should_stop: ShouldStop | None = None,
) -> Solution:
    """Solve for the shape of every frame: the last stage of `solve`.

    Gross outliers are rejected. More than 10 million frames times points (`limits.BLOCK_OBSERVATIONS`) are solved in blocks of points.

    Parameters
    ----------
    tracks : Tracks
        Tracks over the frames of the cameras; the cameras may have been estimated from other points.
    cameras : Cameras
        From `estimate_cameras`.
    prior : Prior, optional
        From `learn_prior`. None uses the prior of `settings`, or smoothness in time if that is `gaussian`.
    mesh : Mesh, optional
        Which points are neighbours; None for no smoothness in space.
    settings : Settings, optional
        Method, loss, weights; None uses the settings of the cameras.
    start : Solution or ndarray, shape (F, P, 3), optional
        Initial shapes, world axes, the tracks' unit; None, or shapes of higher energy, start from least squares. The energy minimised is
        the same either way.
    scratch : path, optional
        Folder for a temporary file that holds the result if the shapes are solved in blocks, as for `solve`.
    on_step : callable, optional
        Called as the solve proceeds, usually at least every half second.
    should_stop : callable, optional
        Called between units of work; once it returns True, the solve ends with `Outcome.STOPPED` and the last shapes.

    Raises
    ------
    InvalidInput
        Mesh, cameras, prior or start do not match the tracks, start is absurdly large, the tracks are no valid `Tracks`, or an argument
        has another type.
    InvalidSettings
        The settings select another prior than the given one, or require a mesh that is a grid.
    NotFinite
        The arithmetic overflowed, or rounding errors made equations singular.
    OSError
        The folder `scratch` is missing, cannot be written to, or has too little space.
    """
    check_tracks(tracks)
    check_types(cameras, prior, mesh, settings)
    observations = cameras.observations.of(tracks)
    first = (
        None if start is None else start_shapes(start.shapes if isinstance(start, Solution) else start, observations)
    )
    settings = settings if settings is not None else observations.settings
    check_mesh(tracks, mesh, settings)
    settings = without_learned_prior(settings) if prior is None else settings
    monitor = monitored(tracks, None, settings, on_step, should_stop, only=("shapes", "finish", "trust"))
    with serial_blas(), pulses_to(monitor.pulse), singular_refused():
        return shapes_of(
            tracks, cameras, prior, mesh, settings, monitor,
            seconds={}, start=None if first is None else first * observations.world_scale, scratch=scratch,
        )  # fmt: skip


def shapes_of(
    tracks: Tracks,
    cameras: Cameras,
    prior: Prior | None,
    mesh: Mesh | None,
    settings: Settings,
    monitor: Monitor,
    *,
    seconds: dict[str, float],
    start: Floats | None = None,
    scratch: str | Path | None,
) -> Solution:
    """Return the solution, at once or in blocks of points; `seconds` is the time per stage so far, `start` and `scratch` as above."""
    if needs_blocks(tracks, settings):
        solution = shapes_in_blocks(
            tracks, cameras, prior, mesh, settings, monitor, seconds=seconds, start=start, scratch=scratch
        )
    else:
        monitor.enter("start")
        began = time.perf_counter()
        begun = [begin(tracks, cameras, prior, mesh, settings, monitor, shapes=start)]
        changes = None  # computed with the final confidence, where the tracks are those of the cameras
        if prior is not None and tracks is not cameras.observations.tracks:
            changes = changes_of(tracks, cameras, prior, seed=settings.seed, should_stop=monitor)
        seconds = {**seconds, "initialise": time.perf_counter() - began}
        del start  # and `pop`: so that `shapes_from` has the only reference and can release the first state
        solution = shapes_from(begun.pop(), monitor, seconds=seconds, changes=changes)
    return in_world_unit(solution, cameras.observations.world_scale)

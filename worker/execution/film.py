"""A complete job from a film: track it in the film process, solve, write the files."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pliant.schemas.job import Artifact, FollowedPoints, Progress
from pliant.schemas.options import Options
from pliant.solver.reconstruction.surface import tries_isometry
from pliant.solver.stages import planned
from pliant.worker.artifacts import described, kinds_for
from pliant.worker.errors import Interrupted
from pliant.worker.execution.pace import MachinePace
from pliant.worker.execution.pipeline import StopCondition, silent, solve_and_write
from pliant.worker.execution.progress import FILM_SHARES, Reporter
from pliant.worker.films import frame_strip
from pliant.worker.films.bounds import FilmBounds
from pliant.worker.films.inputs import read_tracked
from pliant.worker.films.sources import FilmSource
from pliant.worker.films.tracker import OnWarnings, track_film
from pliant.worker.formats.solver_settings import solver_settings
from pliant.worker.jobs.admission import check_fits
from pliant.worker.jobs.finished import Finished

FILES = {
    "tracks.npz": (
        "application/zip",
        "The film's tracks (F, P, 2) in film pixels, visibility, confidence, grid, faces, texture coordinates and times.",
    ),
    "contact_sheet.jpg": ("image/jpeg", "The tracks drawn over some frames of the film."),
    frame_strip.NAME: (frame_strip.MEDIA_TYPE, frame_strip.DESCRIPTION),
}
"""Files of a film job besides those of the reconstruction: media type and description. Very long films have no frame strip."""


def reconstruct_film(
    source: FilmSource,
    options: Options,
    directory: Path,
    *,
    scratch: Path,
    name: str = "",
    threads: int = 1,
    bounds: FilmBounds = FilmBounds(),  # noqa: B008 - frozen
    memory: int = 0,
    on_progress: Callable[[Progress], None] = silent,
    on_warnings: OnWarnings | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Finished:
    """Track the film, solve, evaluate and write the files. Raises the same errors as `pipeline.reconstruct`.

    The first stage is `track`. `scratch` is an empty folder for the film process; `threads` is the thread count of optical flow.
    `memory` is the number of bytes available to the job, 0 if unknown: a film with too many points for it is refused once it is tracked.
    `on_warnings` is that of `track_film`.
    """
    kinds_for(options)
    reporter = Reporter(on_progress, shares=FILM_SHARES)
    halt, pace = StopCondition(should_stop, options.time_limit), MachinePace()
    with reporter.ticking():
        reporter.part("track", 0.0)
        began = time.perf_counter()

        def report_progress(done: float, size: tuple[int, int] | None, followed: FollowedPoints | None) -> None:
            if size is not None:
                reporter.following_seconds = pace.measure() * solving_seconds(*size, options)
            reporter.part("track", done, followed=followed)

        try:
            tracked = track_film(
                source, options, scratch, bounds=bounds, threads=threads,
                on_progress=report_progress, on_warnings=on_warnings, should_stop=halt.requested,
            )  # fmt: skip
        except Interrupted:
            halt.check()
            raise
        if not source.own_rate:
            options = options.model_copy(update={"fps": tracked.fps})
        inputs = read_tracked(scratch / "tracks.npz", tracked, options)
        drawn = inputs.interpretation.model_copy(update={"has_region": source.has_region(options)})
        inputs = replace(inputs, interpretation=drawn)
        check_fits(inputs.interpretation, options, [memory], film=True)
        spent = {"track": time.perf_counter() - began}
        directory.mkdir(parents=True, exist_ok=True)
        artifacts = [_moved(scratch / name, directory) for name in FILES if (scratch / name).exists()]
        finished = solve_and_write(
            inputs, options, directory, reporter=reporter, halt=halt, name=name, spent=spent,
            earlier=artifacts,
        )  # fmt: skip
    return replace(
        finished,
        artifacts=(*artifacts, *finished.artifacts),
        interpretation=inputs.interpretation,
        options=options,
    )


def solving_seconds(frames: int, points: int, options: Options) -> float:
    """Return the planned seconds of solving a film's tracks at a `MachinePace` of 1; the options contain the film's `image_size`."""
    settings = solver_settings(options)
    sheet = tries_isometry(None, settings)
    stages = planned(
        frames, points, gaussian=settings.gaussian, known_cameras=False, sheet=sheet, tolerance=settings.tolerance
    )
    return sum(stage.seconds for stage in stages)


def _moved(file: Path, directory: Path) -> Artifact:
    shutil.move(file, directory / file.name)
    return described(directory / file.name, *FILES[file.name])

"""Run a job that writes further files from a stored result, without solving again."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.schemas.job import Job, Progress
from pliant.solver import Camera, Choices, Outcome, Solution, Trace
from pliant.worker.artifacts import kinds_for
from pliant.worker.artifacts.result import Result, file_warnings
from pliant.worker.artifacts.write import write_kinds, write_report
from pliant.worker.execution.pipeline import StopCondition, report_export, silent
from pliant.worker.execution.progress import Reporter
from pliant.worker.films.inputs import read_tracked
from pliant.worker.films.tracker import Tracked
from pliant.worker.formats import Inputs, load_inputs
from pliant.worker.formats.canonical import OWN_FILES
from pliant.worker.formats.errors import damaged
from pliant.worker.formats.reading.arrays import read_file
from pliant.worker.formats.records import Arrays
from pliant.worker.jobs.finished import Finished

SHARES = {"loading": (0.0, 0.1), "exporting": (0.1, 1.0)}
_NEEDED = frozenset(
    ("shapes", "rotations", "scales", "translations", "focal", "focal_std", "principal_point", "residuals", "weights",
     "trace_objective", "trace_residual", "trace_iterations")
)  # fmt: skip
_OPTIONAL = frozenset(("shapes_std", "inlier_probability"))


def write_further(
    inputs_file: Path,
    result_file: Path,
    job: Job,
    directory: Path,
    *,
    on_progress: Callable[[Progress], None] = silent,
    should_stop: Callable[[], bool] | None = None,
) -> Finished:
    """Write the files requested by a job's options from a stored result.

    `inputs_file` has the inputs of the job that solved (canonical, or the `tracks.npz` of a film), `result_file` is its
    `shapes.npz`. The metrics, verdict and warnings in `job` are those of the result.

    Raises
    ------
    Interrupted, TimedOut
        See `pipeline.reconstruct`.
    InvalidInput
        Code damaged_file: a stored file cannot be read back.
    """
    options, halt = job.options, StopCondition(should_stop, job.options.time_limit)
    reporter = Reporter(on_progress, shares=SHARES)
    reporter.part("loading", 0.0)
    inputs = _inputs(inputs_file, job)
    solution = read_solution(result_file, y_up=inputs.interpretation.y_axis == "up")
    if solution.shapes.shape[:2] != (inputs.tracks.num_frames, inputs.tracks.num_points):
        raise damaged("inputs", "tracks and shapes of different sizes")
    directory.mkdir(parents=True, exist_ok=True)
    result = Result(inputs, solution, options, job.name)
    kinds = [kind for kind in kinds_for(options, textured=result.texture is not None) if kind.output is not None]
    exported = partial(report_export, reporter, halt)
    exported(0.0)
    artifacts, described = write_kinds(result, kinds, directory, on_progress=exported)
    report = {"outputs_of": job.outputs_of, "options": json.loads(options.model_dump_json()), "artifacts": described}
    artifacts.append(write_report(report, directory))
    exported(1.0)
    return Finished(
        metrics=job.metrics or {},
        outcome=job.outcome or solution.outcome.value,
        sentence=job.sentence or solution.outcome.sentence,
        verdict=job.verdict,
        verdict_reasons=tuple(job.verdict_reasons),
        trust_sentence=job.trust_sentence,
        warnings=tuple(dict.fromkeys((*job.warnings, *file_warnings(options, solution)))),
        artifacts=tuple(artifacts),
    )


def read_solution(path: Path, *, y_up: bool) -> Solution:
    """Read the arrays of a `shapes.npz` as a solution.

    The file does not contain the solver's choices: those fields are NaN, 0 or empty, and files written from a stored result omit them.

    Raises
    ------
    InvalidInput
        Code damaged_file: the file was not written by Pliant or is damaged.
    """
    arrays = read_file(path, field="result", limits=OWN_FILES, wanted=_NEEDED | _OPTIONAL)
    missing = sorted(_NEEDED - set(arrays))
    if missing:
        raise damaged("result", f"a shapes.npz without {', '.join(missing)}")
    held = {name: np.asarray(arrays[name], dtype=np.float64) for name in _NEEDED}
    focal, unknown = float(held["focal"]), float("nan")
    camera = Camera(
        held["rotations"], held["scales"], held["translations"], y_up=y_up, principal_point=held["principal_point"],
        focal=focal if np.isfinite(focal) else None, focal_std=float(held["focal_std"]) if np.isfinite(focal) else None,
    )  # fmt: skip
    return Solution(
        shapes=held["shapes"],
        camera=camera,
        residuals=held["residuals"],
        weights=held["weights"],
        trace=Trace(held["trace_objective"], held["trace_residual"], held["trace_iterations"].astype(np.int64)),
        outcome=Outcome.CONVERGED,
        choices=Choices(
            basis_size=0, temporal_weight=unknown, spatial_weight=unknown, robust_scale=unknown, temporal_order=0,
            low_rank_weight=unknown, laplacian="", unit=unknown, noise=unknown,
        ),
        seconds={},
        shapes_std=_optional(arrays, "shapes_std"),
        inlier_probability=_optional(arrays, "inlier_probability"),
    )  # fmt: skip


def _optional(arrays: Arrays, name: str) -> NDArray[np.float64] | None:
    return np.asarray(arrays[name], dtype=np.float64) if name in arrays else None


def _inputs(file: Path, job: Job) -> Inputs:
    try:
        with zipfile.ZipFile(file) as archive:
            canonical = "interpretation.npy" in archive.namelist()
    except zipfile.BadZipFile as error:
        raise damaged("inputs", "inputs that cannot be read back") from error
    if canonical:
        return load_inputs(file)
    return read_tracked(file, Tracked(container="stored", fps=job.options.fps, warnings=()), job.options)

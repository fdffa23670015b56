"""Run a complete job, from inputs to files, in one call; used by `pliant solve` and by the workers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from pliant.schemas.job import Artifact, Progress
from pliant.schemas.options import Options
from pliant.solver import Outcome, Solution, Step, solve
from pliant.solver.evaluation.metrics import evaluate
from pliant.worker.artifacts import build_report, kinds_for, write_artifacts
from pliant.worker.artifacts.result import file_warnings
from pliant.worker.errors import Interrupted, TimedOut
from pliant.worker.execution.progress import Reporter
from pliant.worker.formats import Inputs
from pliant.worker.formats.solver_settings import solver_settings
from pliant.worker.jobs.finished import Finished

EXPORT_SECONDS = 1.5e-7
"""Seconds per frame and point to write a file whose `share` is 1, measured on a face of 99 frames and 3,000 points."""


def silent(progress: Progress) -> None:
    """Ignore the progress."""
    del progress


def reconstruct(
    inputs: Inputs,
    options: Options,
    directory: Path,
    *,
    name: str = "",
    on_progress: Callable[[Progress], None] = silent,
    should_stop: Callable[[], bool] | None = None,
    solver: Callable[..., Solution] | None = None,
) -> Finished:
    """Solve, evaluate, and write the files into a directory, which is created if missing.

    `on_progress` and `should_stop` are called frequently. `solver` replaces `pliant.solver.solve`, in tests.

    Raises
    ------
    Interrupted
        `should_stop` returned True; some files may have been written.
    TimedOut
        The job took longer than `options.time_limit`.
    InvalidInput
        Inputs and options contradict each other, or a requested file cannot be written in this installation.
    """
    # Reject files that cannot be written before computing anything.
    kinds_for(options, size=(inputs.tracks.num_frames, inputs.tracks.num_points))
    reporter = Reporter(on_progress)
    halt = StopCondition(should_stop, options.time_limit)
    with reporter.ticking():
        return solve_and_write(inputs, options, directory, name=name, reporter=reporter, halt=halt, solver=solver)


def solve_and_write(
    inputs: Inputs,
    options: Options,
    directory: Path,
    *,
    reporter: Reporter,
    halt: StopCondition,
    name: str = "",
    spent: Mapping[str, float] | None = None,
    earlier: Sequence[Artifact] = (),
    solver: Callable[..., Solution] | None = None,
) -> Finished:
    """Run `reconstruct` as part of a longer job.

    The reporter receives the parts `loading`, `solving` and `exporting`. `spent` (seconds) and `earlier` (files in the
    same directory) come from earlier parts and are included in the report.
    """
    directory.mkdir(parents=True, exist_ok=True)
    size = inputs.tracks.num_frames, inputs.tracks.num_points
    written = kinds_for(options, size=size, textured=inputs.texture is not None)
    reporter.export_seconds = EXPORT_SECONDS * size[0] * size[1] * sum(kind.share for kind in written)
    reporter.part("loading", 1.0)
    began = time.perf_counter()
    solution = (solver or solve)(
        inputs.tracks,
        inputs.mesh,
        cameras=inputs.cameras,
        settings=solver_settings(options, y_up=inputs.interpretation.y_axis == "up"),
        on_step=lambda step: _report_step(reporter, step),
        should_stop=halt.requested,
    )
    if solution.outcome is Outcome.STOPPED:
        halt.check()
    solved = time.perf_counter()
    metrics = _metrics(inputs, solution)
    seconds = {**(spent or {}), "solve": solved - began, "metrics": time.perf_counter() - solved}
    report = build_report(inputs, solution, options, metrics=metrics, seconds=seconds, name=name)
    report["warnings"] = [*inputs.warnings, *report["warnings"], *file_warnings(options, solution)]
    report["artifacts"] = {each.name: {"bytes": each.bytes, "sha256": each.sha256} for each in earlier}
    exported = partial(report_export, reporter, halt)
    artifacts = write_artifacts(inputs, solution, options, report, directory, name=name, on_progress=exported)
    return Finished(
        metrics=metrics,
        outcome=report["outcome"],
        sentence=report["sentence"],
        verdict=report["verdict"],
        verdict_reasons=tuple(report["verdict_reasons"]),
        trust_sentence=report["trust_sentence"],
        camera_sentence=report["camera"]["sentence"],
        warnings=tuple(report["warnings"]),
        artifacts=tuple(artifacts),
    )


def report_export(reporter: Reporter, halt: StopCondition, done: float) -> None:
    """Report the completed share of the export, which stops here if the job must."""
    reporter.part("exporting", done)
    halt.check()


@dataclass(slots=True)
class StopCondition:
    """The stop condition of a job with its reason; once requested, a stop stays requested."""

    should_stop: Callable[[], bool] | None
    limit: float | None
    began: float = field(default_factory=time.monotonic)
    reason: Interrupted | TimedOut | None = None

    def requested(self) -> bool:
        """Return whether the job has to stop."""
        if self.reason is None and self.should_stop is not None and self.should_stop():
            self.reason = Interrupted()
        if self.reason is None and self.limit is not None and time.monotonic() > self.began + self.limit:
            self.reason = TimedOut(self.limit)
        return self.reason is not None

    def check(self) -> None:
        """Raise the reason to stop, if any."""
        if self.requested() and self.reason is not None:
            raise self.reason


def _metrics(inputs: Inputs, solution: Solution) -> dict[str, float]:
    truth = inputs.ground_truth
    rotations = None if truth is None else truth.rotations
    values = evaluate(solution, inputs.tracks, None if truth is None else truth.shapes, rotations)
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _report_step(reporter: Reporter, step: Step) -> None:
    reporter.part(
        "solving",
        step.fraction,
        stage=step.stage,
        reweighting=step.reweighting,
        max_reweightings=step.max_reweightings,
        objective=step.objective,
        residual=step.residual,
        seconds_left=step.seconds_left,
    )

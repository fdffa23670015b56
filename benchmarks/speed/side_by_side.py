"""Compare the solver with baseline minimisers on one energy."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pliant.solver import KnownCamera, Mesh, Settings, Solution, Tracks, gallery, solve
from pliant.solver.cameras.estimation import CameraEstimate
from pliant.solver.energy.problem import Problem
from pliant.solver.evaluation.metrics import e3d_frame
from pliant.solver.shapes.initialization import pseudo_inverse, uniform_solution
from pliant.solver.shapes.setup import build_problem
from pliant.solver.tracks.normalization import normalize

from benchmarks.accuracy.cells import parse_settings
from benchmarks.sequences import Case, cases, from_gallery
from benchmarks.speed import baselines
from benchmarks.speed.apart import Measured, Stopwatch, apart

GAP = 1.01
"""Energy, relative to the solver's final one, at which a baseline is done: within 1 %."""

MOST_COMPARED = 20_000_000
"""Maximum number of observations in the error, which takes about 150 bytes for each."""

BASELINES = ("conjugate_gradients", "gradient_descent", "direct")


@dataclass(frozen=True, slots=True, kw_only=True)
class Workload:
    """A corrupted sequence by name, so that each process can rebuild it."""

    data: Path | None = None
    only: str = "face"
    kind: str = "face"
    """Gallery sequence: face, flag, sphere or talk."""
    frames: int = 20
    points: int | None = None
    outliers: float = 0.10
    noise: float = 0.0
    mesh: str = "grid"
    known: bool = True
    """Whether true cameras are given, so that only the shapes are measured."""
    settings: str = "prior=smooth"
    start: str = "tracks"
    """Start of the baselines: `tracks`, the pseudo-inverse R†(W − t), or `ours`, the solver's own start."""
    scratch: Path | None = None
    """Folder for the temporary file that holds the result of a large solve; None keeps it in memory."""

    def case(self) -> Case:
        """Read or generate the sequence, and corrupt it."""
        if self.data is None:
            make = getattr(gallery, self.kind)
            options = {} if self.kind == "sphere" else {"mesh": self.mesh}
            made = from_gallery(make(self.frames, self.points or 1500, **options), self.kind)
        else:
            made = next(iter(cases(self.data, points=self.points, visibility="file", only=[self.only])))
        if self.outliers == self.noise == 0:
            return made
        tracks, _ = gallery.corrupt_tracks(made.tracks, outliers=self.outliers, noise=self.noise)
        return replace(made, tracks=tracks)

    def chosen(self) -> Settings:
        """Return the solver's settings."""
        return Settings(**parse_settings(self.settings))


@dataclass(frozen=True, slots=True)
class Ours:
    """Measurements of one solve."""

    reached: tuple[float, float]
    """Wall and CPU seconds until the energy was within 1 % of its final value, everything included."""
    started: tuple[float, float]
    """Part of `reached` before the baselines' start: normalisation, cameras, weights, and the start itself."""
    objective: float
    translations: np.ndarray
    """Final translations in normalised units, which the baselines are given."""
    iterations: int
    reweightings: int
    stages: dict[str, float]
    error: float | None
    size: tuple[int, int]
    silence: float
    """Longest time between two progress reports, s."""


def run_ours(watch: Stopwatch, work: Workload) -> Ours:
    """Solve, after a tiny solve that does the one-time imports."""
    solved(Workload(frames=4, points=50, settings=work.settings))
    case, history = work.case(), []
    normalized = normalize(case.tracks)
    centroid, unit = normalized.centroid, normalized.unit
    del normalized
    watch.start()
    solution = solve(
        case.tracks, case.mesh, cameras=case.cameras if work.known else None, settings=work.chosen(), scratch=work.scratch,
        on_step=lambda step: history.append((time.perf_counter() - watch.began, time.process_time() - watch.cpu, step.objective)),
    )  # fmt: skip
    moments = [0.0, *(wall for wall, _, _ in history), time.perf_counter() - watch.began]
    best = float(solution.trace.objective[-1])
    valued = [entry for entry in history if entry[2] is not None]
    reached = next((wall, cpu) for wall, cpu, value in valued if value <= GAP * best)
    return Ours(
        reached, valued[0][:2], best, (solution.camera.translations - centroid) / unit,
        int(solution.trace.iterations.sum()), len(solution.trace.objective) - 1, dict(solution.seconds),
        _error(solution, case), case.tracks.points.shape[:2], float(np.diff(moments).max()),
    )  # fmt: skip


def _error(solution: Solution, case: Case) -> float | None:
    """Return `e3d_frame`, on evenly spread points if there are more than `MOST_COMPARED` observations."""
    if case.shapes is None:
        return None
    every = -(-case.shapes[..., 0].size // MOST_COMPARED)
    return e3d_frame(solution.shapes[:, ::every], case.shapes[:, ::every])


def run_baseline(watch: Stopwatch, work: Workload, name: str, ours: Ours, cap: float) -> baselines.Run:
    """Run one baseline until it is within 1 % of the solver's energy or `cap` seconds have passed."""
    case = work.case()
    assert case.cameras is not None
    problem, start = prepare(case.tracks, case.mesh, case.cameras, work.chosen())
    if work.start == "tracks":
        start = pseudo_inverse(problem, ours.translations)
    watch.start()
    run: baselines.Run = getattr(baselines, name)(
        problem, start, ours.translations, target=GAP * ours.objective, cap=cap
    )
    return run


def prepare(tracks: Tracks, mesh: Mesh | None, cameras: KnownCamera, settings: Settings) -> tuple[Problem, np.ndarray]:
    """Build the solver's problem and its start, in normalised units."""
    still = np.zeros((tracks.num_frames, 2))
    scales = np.ones(tracks.num_frames) if cameras.scales is None else cameras.scales
    estimate = CameraEstimate(cameras.rotations, scales, still, 0, np.zeros((0, 0)), np.zeros((len(scales), 0, 2)))
    problem, _ = build_problem(normalize(tracks), estimate, mesh, settings)
    return problem, uniform_solution(problem, still)


def compare(work: Workload, *, names: list[str], cap: float, limit: int) -> list[str]:
    """Measure the solver and every baseline; return the lines of a Markdown table."""
    measured = apart(run_ours, work)
    assert measured is not None, "the solver ran out of memory"
    ours: Ours = measured.value
    (wall, cpu), (late, busy) = ours.reached, from_start(ours)
    frames, points = ours.size
    lines = [
        f"{frames} × {points}, {work.outliers:.0%} outliers, `{work.settings}`, baselines from "
        f"{'the pseudo-inverse' if work.start == 'tracks' else 'our start'}; load {measured.load:.1f}",
        "",
        "| | energy / ours | seconds (CPU) | × our whole time (CPU) | × ours from the start (CPU) | iterations | peak memory |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        f"| ours, within 1 %, whole | {GAP:g} | {wall:.1f} ({cpu:.1f}) | 1 | | | |",
        f"| ours, within 1 %, from the start | {GAP:g} | {late:.1f} ({busy:.1f}) | | 1 | | |",
        f"| ours, to the end | 1 | {measured.seconds:.1f} ({measured.cpu_seconds:.1f}) | {measured.seconds / wall:.1f} "
        f"({measured.cpu_seconds / cpu:.1f}) | | {ours.iterations} in {ours.reweightings} | {measured.peak / 1e9:.2f} GB |",
    ]
    for line in lines:
        print(line, flush=True)
    for name in names:
        lines.append(_line(name, apart(run_baseline, work, name, ours, cap, limit=limit), ours, limit))
        print(lines[-1], flush=True)
    return lines


def _line(name: str, done: Measured | None, ours: Ours, limit: int) -> str:
    label = name.replace("_", " ")
    if done is None:
        return f"| {label} | – | does not fit | – | – | – | > {limit / 1e9:.0f} GB |"
    run: baselines.Run = done.value
    (wall, cpu), (late, busy) = ours.reached, from_start(ours)
    ending = ""
    energy = run.objective[-1] / ours.objective
    seconds, cpu_seconds = done.seconds, done.cpu_seconds
    if not run.reached:
        whole = extrapolated(run, best=ours.objective)
        ending = f"; not there after {done.seconds:.0f} s, extrapolated"
        cpu_seconds *= whole / seconds
        seconds = whole
    if not np.isfinite(seconds):
        label, ending = f"{label}; not there after {done.seconds:.0f} s, no rate to go by", ""
    return (
        f"| {label}{ending} | {energy:.3f} | {seconds:.1f} ({cpu_seconds:.1f}) | {seconds / wall:.1f} ({cpu_seconds / cpu:.1f}) "
        f"| {seconds / late:.1f} ({cpu_seconds / busy:.1f}) | {run.iterations} | {done.peak / 1e9:.2f} GB |"
    )


def from_start(ours: Ours) -> tuple[float, float]:
    """Return wall and CPU seconds from the baselines' start to within 1 % of the final energy."""
    wall, cpu = (max(end - begin, 1e-3) for end, begin in zip(ours.reached, ours.started, strict=True))
    return wall, cpu


def extrapolated(run: baselines.Run, *, best: float) -> float:
    """Extrapolate the seconds until a run is within 1 % of `best` from the rate of its last half.

    The gap to the best energy falls ever more slowly, and geometrically at the end of a descent, so the estimate errs low. Infinite if the
    gap does not fall.
    """
    seconds, gap = np.array(run.seconds), np.array(run.objective) / best - 1
    late = seconds >= seconds[-1] / 2
    if late.sum() < 2:
        return float("inf")
    slope, _ = np.polyfit(seconds[late], np.log(gap[late]), 1)
    falls = slope * np.ptp(seconds[late]) < -1e-9
    return float(seconds[-1] + np.log((GAP - 1) / gap[-1]) / slope) if falls else float("inf")


def solved(work: Workload) -> Solution:
    """Solve in this process."""
    case = work.case()
    return solve(case.tracks, case.mesh, cameras=case.cameras if work.known else None, settings=work.chosen())

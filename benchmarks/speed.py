"""Time side by side, and growth with the size.

    python -m benchmarks.speed compare --frames 20 --points 1500
    python -m benchmarks.speed growth

`compare`: the solver against the baselines on one energy (a gallery face with 10 % outliers, true cameras, the paper's
weights). Each baseline begins at the solver's own start and runs until it is within 1 % of the solver's energy or its time is up.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from pliant.solver import KnownCamera, Mesh, Settings, Solution, Tracks, solve
from pliant.solver.cameras import CameraEstimate
from pliant.solver.closed_form import uniform_solution
from pliant.solver.gallery import corrupt, face
from pliant.solver.normalise import normalise
from pliant.solver.problem import build_problem
from pliant.solver.state import Problem

from benchmarks import baselines

GAP = 1.01
PAPER = Settings(preset="paper", prior="smooth")


def prepare(
    tracks: Tracks, mesh: Mesh | None, cameras: KnownCamera, settings: Settings, solution: Solution
) -> tuple[Problem, np.ndarray, np.ndarray]:
    """Build the solver's problem, its start, and its final translations, normalised units."""
    normalised = normalise(tracks)
    still = np.zeros((tracks.num_frames, 2))
    scales = np.ones(tracks.num_frames) if cameras.scales is None else cameras.scales
    problem, _ = build_problem(normalised, CameraEstimate(cameras.rotations, scales, still, 0, {}, ()), mesh, settings)
    translations = (solution.camera.translations - normalised.centroid) / normalised.unit
    return problem, uniform_solution(problem, still), translations


def compare(frames: int, points: int, cap: float) -> None:
    """Print one line for the solver and one for every baseline."""
    made = corrupt(face(frames, points), outliers=0.1, noise=0.01)
    cameras = KnownCamera.from_arrays(made.rotations, made.scales)
    history: list[tuple[float, float]] = []
    began = time.perf_counter()
    solution = solve(
        made.tracks, made.mesh, cameras=cameras, settings=PAPER,
        on_step=lambda step: history.append((time.perf_counter() - began, step.objective or np.inf)),
    )  # fmt: skip
    best = float(solution.trace.objective[-1])
    within = next(seconds for seconds, value in history if value <= GAP * best)
    print(f"ours: within 1 % of its energy after {within:.2f} s, converged after {history[-1][0]:.2f} s", flush=True)
    problem, start, translations = prepare(made.tracks, made.mesh, cameras, PAPER, solution)
    for run in (baselines.conjugate_gradients, baselines.gradient_descent, baselines.direct):
        done = run(problem, start, translations, target=GAP * best, cap=cap)
        end = "reached" if done.reached else "cut off by the time cap, not reached"
        ratio = done.seconds[-1] / within
        print(
            f"{run.__name__}: {done.seconds[-1]:.2f} s, {done.objective[-1] / best:.4f} × ours, {end}, {ratio:.2f} × our time",
            flush=True,
        )


def growth() -> None:
    """Print time against P and F, and the fitted exponents."""
    for name, sizes in (("P", (1000, 2000, 4000, 8000)), ("F", (10, 20, 40, 80))):
        seconds = [_timed(20, size) if name == "P" else _timed(size, 1000) for size in sizes]
        print(name, ", ".join(f"{size}: {value:.2f} s" for size, value in zip(sizes, seconds, strict=True)))
        print(f"exponent in {name}: {exponent(np.array(sizes, float), np.array(seconds)):.2f}", flush=True)


def exponent(sizes: np.ndarray, seconds: np.ndarray) -> float:
    """Slope of log time over log size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def _timed(frames: int, points: int) -> float:
    made = corrupt(face(frames, points), outliers=0.05)
    cameras = KnownCamera.from_arrays(made.rotations, made.scales)
    began = time.perf_counter()
    solve(made.tracks, made.mesh, cameras=cameras, settings=PAPER)
    return time.perf_counter() - began


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("compare", "growth"))
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--points", type=int, default=1500)
    parser.add_argument("--cap", type=float, default=120.0, help="seconds a baseline may take")
    options = parser.parse_args()
    if options.what == "compare":
        compare(options.frames, options.points, options.cap)
    else:
        growth()


if __name__ == "__main__":
    main()

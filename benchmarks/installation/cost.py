"""Compare memory and processor time of whole jobs with their estimates: `python -m benchmarks.installation.cost [--near]`."""

from __future__ import annotations

import argparse
import json
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import Settings, gallery, solve, threads_limited
from pliant.worker.execution.pipeline import reconstruct
from pliant.worker.formats import Inputs
from pliant.worker.formats.cost import estimated

from benchmarks.accuracy.distances import PICTURE, seen_from
from benchmarks.accuracy.spoiling import Spoiling, spoiled
from benchmarks.sequences import Case, from_gallery

SIZES = (
    (10, 500),
    (10, 5_000),
    (10, 40_000),
    (50, 500),
    (50, 2_000),
    (50, 10_000),
    (100, 500),
    (100, 2_000),
    (200, 500),
)
"""Frames and points."""

NEAR_SIZES, DISTANCE, NOISE = ((30, 300), (30, 1_500), (60, 500), (120, 1_000)), 5.0, 0.5
"""Frames and points; distance of the camera in half-sizes; standard deviation of the noise, px."""


def measure(frames: int, points: int) -> None:
    """Run one job in this process; print its peak memory and processor time."""
    sequence = gallery.corrupt(gallery.face(frames, points), noise=0.5)
    count = sequence.tracks.num_points
    stated = Interpretation(
        num_frames=frames, num_points=count, num_faces=0, hidden_fraction=0, mesh_source="given", has_ground_truth=False,
        has_rotations=False, layout="",
    )  # fmt: skip
    began = time.process_time()
    with threads_limited(1), tempfile.TemporaryDirectory() as folder:
        reconstruct(Inputs(sequence.tracks, sequence.mesh, None, None, stated), Options(), Path(folder))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps({"points": count, "peak": peak, "seconds": time.process_time() - began}))


def near() -> None:
    """Print the times of solves with a known picture size, from nearby and afar, and their estimate."""
    print(f"{'frames × points':>17} {'near':>6} {'20 % hidden':>12} {'far, hidden':>12} {'estimate':>9}")
    for frames, points in NEAR_SIZES:
        case = from_gallery(gallery.face(frames, points, degrees=40), "face")
        hidden = Spoiling(noise=NOISE, hidden=0.2)
        near = _seconds(case, DISTANCE, Spoiling(noise=NOISE)), _seconds(case, DISTANCE, hidden)
        far = _seconds(case, float("inf"), hidden)
        size = f"{PICTURE[0]:.0f}x{PICTURE[1]:.0f}"
        guess = estimated(frames, len(case.tracks.points[0]), Options(image_size=size)).seconds
        print(f"{frames:>6} × {points:<8,} {near[0]:>6.1f} {near[1]:>12.1f} {far:>12.1f} {guess:>9.1f}", flush=True)


def _seconds(case: Case, distance: float, spoiling: Spoiling) -> float:
    tracks = spoiled(seen_from(case, distance)[0], spoiling)
    began = time.process_time()
    with threads_limited(1):
        solve(tracks, case.mesh, settings=Settings(image_size=PICTURE))
    return time.process_time() - began


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--near", action="store_true", help="time of the solver with a known picture size: near the camera with noise, with 20 %% hidden "
        "observations on top, and these far away",
    )  # fmt: skip
    parser.add_argument(
        "--measure", type=int, nargs=2, metavar=("FRAMES", "POINTS"), help="one job, in this process; prints JSON"
    )
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the process that measures ends, too
    if given.near:
        near()
    elif given.measure:
        measure(*given.measure)
    else:
        compare()


def compare() -> None:
    """Measure every size in a separate process."""
    print(f"{'frames × points':>17} {'peak, MB':>9} {'estimate':>9} {'seconds':>9} {'estimate':>9}")
    for frames, points in SIZES:
        command = [sys.executable, "-m", "benchmarks.installation.cost", "--measure", str(frames), str(points)]
        found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        guess = estimated(frames, found["points"], Options())
        print(
            f"{frames:>6} × {found['points']:<8,} {found['peak'] / 1e6:>9.0f} {guess.memory_bytes / 1e6:>9.0f} "
            f"{found['seconds']:>9.1f} {guess.seconds:>9.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()

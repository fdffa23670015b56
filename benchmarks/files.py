"""Measure size, writing time and memory of every result file, with the gallery's face as the result.

    python -m benchmarks.files                                   99 frames of 29,000 points
    python -m benchmarks.files --sequence DIR/facescan99_rot30      a recorded sequence
    python -m benchmarks.files --frames 300 --points 2000 --options '{"colours": "error", "normals": "animated"}'

Nothing is solved: the truth stands in for the result, because file sizes do not depend on its accuracy, except those of compressed files.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import tracemalloc
from pathlib import Path

import numpy as np
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import Camera, Choices, Outcome, Solution, Trace
from pliant.solver.gallery import face
from pliant.worker.artifacts.kinds import kinds_for
from pliant.worker.artifacts.result import Result
from pliant.worker.formats import GroundTruth, Inputs

from benchmarks.sequences import Case, from_gallery, read_case

ALL = "glb,ply,obj,usd,mat,csv"


def main() -> None:
    """Write every file once and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=99)
    parser.add_argument("--points", type=int, default=29_000)
    parser.add_argument("--options", type=json.loads, default={}, help="JSON object, as a job's")
    parser.add_argument("--sequence", type=Path, help="a recorded sequence whose true shapes stand for the result")
    given = parser.parse_args()
    options = Options(**{"outputs": ALL, **given.options})
    result = (
        finished(given.frames, given.points, options) if given.sequence is None else recorded(given.sequence, options)
    )
    frames, points = result.solution.residuals.shape
    print(
        f"{frames} frames × {points} points, {len(result.faces)} faces; a copy of the shapes is {24e-6 * frames * points:.0f} MB"
    )
    print("| file | MB | bytes per frame and point | seconds | MB held while writing |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for kind in kinds_for(result.options):
            size, seconds, held = measured(kind, result, Path(folder) / kind.name)
            print(
                f"| {kind.name} | {size / 1e6:.1f} | {size / (frames * points):.1f} | {seconds:.1f} | {held / 1e6:.0f} |"
            )


def measured(kind, result: Result, path: Path) -> tuple[int, float, int]:
    """Return bytes, seconds, and the peak bytes of Python and NumPy memory held besides the result.

    Writes twice, because tracing memory slows writing down.
    """
    began = time.perf_counter()
    with path.open("wb") as file:
        kind.write(result, file, lambda _: None)
    seconds = time.perf_counter() - began
    tracemalloc.start()
    with path.open("wb") as file:
        kind.write(result, file, lambda _: None)
    _, held = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return path.stat().st_size, seconds, held


def finished(frames: int, points: int, options: Options) -> Result:
    """Return the gallery's face as the result of a job; see `as_result`."""
    made = face(frames, points, degrees=30)
    return as_result(from_gallery(made, "face"), options)


def recorded(folder: Path, options: Options) -> Result:
    """Return the true shapes of a recorded sequence as the result of a job."""
    return as_result(read_case(folder), options)


def as_result(case: Case, options: Options) -> Result:
    """Return a case's truth, scaled by 1.001, as a finished job; independent noise of every point would need a mode per frame."""
    frames, count = case.tracks.visible.shape
    assert case.shapes is not None
    assert case.cameras is not None
    residuals = np.abs(np.random.default_rng(0).normal(0, 0.3, (frames, count))) * (case.tracks.visible > 0)
    scales = np.ones(frames) if case.cameras.scales is None else case.cameras.scales
    solution = Solution(
        shapes=1.001 * case.shapes,
        camera=Camera(case.cameras.rotations, scales, np.zeros((frames, 2))),
        residuals=residuals,
        weights=1 / (1 + residuals),
        trace=Trace(np.array([2.0, 1.0]), np.array([1.0, 0.5]), np.array([0, 9], dtype=np.int32)),
        outcome=Outcome.CONVERGED,
        choices=Choices(
            basis_size=1, temporal_weight=1.0, spatial_weight=1.0, robust_scale=1.0, temporal_order=1, low_rank_weight=0.0,
            laplacian="grid8", unit=1.0, noise=0.0, reasons={}, warnings=(),
        ),
        seconds={},
        shapes_std=1 + residuals,
        inlier_probability=np.exp(-residuals),
    )  # fmt: skip
    interpretation = Interpretation(
        num_frames=frames, num_points=count, num_faces=0 if case.mesh is None else len(case.mesh.faces), hidden_fraction=0.0,
        mesh_source="given", has_ground_truth=True, has_rotations=False, layout="tracks (F, P, 2)",
    )  # fmt: skip
    truth = GroundTruth.from_arrays(case.shapes, None, like=(frames, count))
    return Result(Inputs(case.tracks, case.mesh, truth, None, interpretation), solution, options)


if __name__ == "__main__":
    main()

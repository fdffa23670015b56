"""Calibration of the verdict, the expected error and the standard deviations against ground truth.

    python -m benchmarks.trust [--data DIR] [--only NAME] [--kinds clean,noise] [--points N] [--out FILE]
    python -m benchmarks.trust --tables [--into docs/explanation/trust.md]

Solves every sequence of the gallery and of DIR clean and spoiled: with noise of .02 of the largest coordinate, 10 % gross outliers, 30 %
more points hidden, all three, shuffled frames, or one repeated frame (a still body). Cameras are estimated, or the true ones where the file
has them (`given`, `given all`). White noise serves as a sequence without truth. Photographs in pixels are solved with and without
`image_size`. Each solve is one JSON line and is done only once, so the command can be interrupted and restarted.

The error is `e3d_frame`, or `e3d_frame_scaled` for photographs, whose truth is in millimetres. `quantiles` holds those of |error| over
standard deviation at 1, 2, … 99 %, from which the coverage of any interval follows. Sequences are split by name: constants of
`solver.evaluation.trust` and `solver.shapes.assessment` are chosen on those in `CALIBRATION` only.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pliant.solver import KnownCamera, Settings, Solution, Tracks, solve
from pliant.solver.evaluation.alignment import align
from pliant.solver.evaluation.metrics import coverage, e3d_frame
from pliant.solver.gallery import corrupt_tracks

from benchmarks.rows import append_row, parser_of, rows
from benchmarks.sequences import Case, cases
from benchmarks.trust_tables import written

CALIBRATION = (
    "aura_anim_rot45", "akhter_dance", "akhter_pickup", "facescan10_rot90", "flag", "ict_beat_9k_rot30", "kinect_paper_dense23",
    "shark_objframe", "sphere", "white_noise_1",
)  # fmt: skip
"""Sequences used to choose constants: every second one of each kind (faces, mocap, bodies, sheets, gallery)."""

SPOILED: dict[str, dict[str, float]] = {
    "clean": {},
    "noise": {"noise": 0.02},
    "outliers": {"outliers": 0.1},
    "hidden": {"hidden": 0.3},
    "all": {"noise": 0.02, "outliers": 0.1, "hidden": 0.3},
}
KINDS = (*SPOILED, "given", "given all", "shuffled", "still")
"""Variants in which a sequence is solved."""

QUANTILES = np.linspace(0.01, 0.99, 99)

IMAGE_SIZES = {"kinect_paper_dense23": (640.0, 480.0)}
"""Image sizes, px, of photographs whose `about.json` lacks them."""

Job = tuple[str, str, Case, Settings, bool]
"""Name, kind, sequence to solve, settings, and whether the truth has its own unit."""


def jobs(data: Path | None, *, points: int, only: list[str], kinds: list[str]) -> Iterator[Job]:
    """Yield every solve; `case.cameras` is None where cameras are estimated."""
    found = list(cases(None, points=points, visibility="file", only=only))
    if data is not None:
        found += [case for case in cases(data, points=points, visibility="file", only=only) if case.shapes is not None]
    for kind in kinds:
        for case in found:
            done = spoiled(case, kind)
            if done is None:
                continue
            size = image_size(data, case.name)
            yield case.name, kind, done, Settings(), size is not None
            if size is not None and not kind.startswith("given"):
                yield f"{case.name} with image_size", kind, done, Settings(image_size=size, y_up=case.y_up), True
    for seed in (1, 2):
        name = f"white_noise_{seed}"
        if "clean" in kinds and (not only or any(word in name for word in only)):
            noise = Tracks.from_arrays(np.random.default_rng(seed).standard_normal((30, 40, 2)))
            yield name, "clean", Case(name, noise, None, None, None), Settings(), False


def spoiled(case: Case, kind: str) -> Case | None:
    """Return the sequence to solve; None if the kind does not apply."""
    if kind.startswith("given"):
        corruption = SPOILED["all" if kind == "given all" else "clean"]
        return None if case.cameras is None else replace(case, tracks=corrupt_tracks(case.tracks, **corruption)[0])
    case = replace(case, cameras=None)
    frames = case.tracks.num_frames
    if kind == "shuffled":
        order = np.random.default_rng(0).permutation(frames)
        tracks = Tracks.from_arrays(case.tracks.points[order], case.tracks.visible[order])
        return replace(case, tracks=tracks, shapes=None if case.shapes is None else case.shapes[order])
    if kind == "still":
        middle = np.full(frames, frames // 2)
        tracks = Tracks.from_arrays(case.tracks.points[middle], case.tracks.visible[middle])
        tracks = corrupt_tracks(tracks, noise=1e-3)[0]
        return replace(case, tracks=tracks, shapes=None if case.shapes is None else case.shapes[middle])
    return replace(case, tracks=corrupt_tracks(case.tracks, **SPOILED[kind])[0])


def image_size(data: Path | None, name: str) -> tuple[float, float] | None:
    """Return the size of the photographs of a sequence in pixels, from its `about.json`."""
    about = None if data is None else data / name / "about.json"
    known = json.loads(about.read_text()).get("image_size") if about is not None and about.exists() else None
    return IMAGE_SIZES.get(name) if known is None else (float(known[0]), float(known[1]))


def measured(case: Case, solution: Solution, *, scale_free: bool) -> dict[str, Any]:
    """Return verdict, expected and true error, and quantiles of the errors over their standard deviations.

    `scale_free`: the truth has its own unit.
    """
    trust = solution.trust
    assert trust is not None
    row: dict[str, Any] = {
        "frames": case.tracks.num_frames, "points": case.tracks.num_points, "verdict": trust.verdict.value, "reasons": list(trust.reasons),
        "expected": trust.expected_error, "interval": trust.interval, "residual": trust.residual, "turn": trust.turn_degrees,
        "hidden": trust.hidden, "held_out": trust.held_out_error, "degrees_per_frame": trust.degrees_per_frame,
        "deformation_per_frame": trust.deformation_per_frame, "true": None,
    }  # fmt: skip
    if case.shapes is None:
        return row
    scaled = align(solution.shapes, case.shapes, kind="frame_scaled")
    row["true"] = float(scaled.relative.mean()) if scale_free else e3d_frame(solution.shapes, case.shapes)
    if solution.shapes_std is not None:
        std = scaled.scales[:, None] * solution.shapes_std
        ratio = scaled.distances / np.maximum(std, np.finfo(float).tiny)
        row["quantiles"] = np.quantile(ratio, QUANTILES).round(4).tolist()
        row["coverage"] = coverage(solution.shapes_std, solution.shapes, case.shapes)
        row["std_over_error"] = float(std.mean() / np.sqrt(np.square(scaled.distances).mean()))
    return row


def main(arguments: list[str] | None = None) -> None:
    """Measure the missing solves, or print the tables."""
    parser = parser_of(__doc__, out=Path("benchmarks/results/trust.jsonl"), points=300)
    parser.add_argument("--kinds", default=",".join(KINDS), help="comma-separated: " + ", ".join(KINDS))
    parser.add_argument("--tables", action="store_true", help="print the tables instead of measuring")
    parser.add_argument("--into", type=Path, help="replace the tables of this page")
    given = parser.parse_args(arguments)
    if given.tables:
        written(rows(given.out), CALIBRATION, given.into)
        return
    done = {(row["sequence"], row["kind"]) for row in rows(given.out)}
    for name, kind, case, settings, scale_free in jobs(
        given.data, points=given.points, only=given.only, kinds=given.kinds.split(",")
    ):
        if (name, kind) in done:
            continue
        cameras: KnownCamera | None = case.cameras
        began = time.process_time()
        solution = solve(case.tracks, case.mesh, cameras=cameras, settings=settings)
        seconds = round(time.process_time() - began, 1)
        row = {
            "sequence": name,
            "kind": kind,
            **measured(case, solution, scale_free=scale_free),
            "cpu_seconds": seconds,
        }
        append_row(given.out, row)
        expected, true = (np.nan if row[key] is None else row[key] for key in ("expected", "true"))
        print(f"{name:36} {kind:10} {row['verdict']:11} expected {expected:.4f} true {true:.4f}", flush=True)


if __name__ == "__main__":
    main()

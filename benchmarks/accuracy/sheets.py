"""Compare the solver on real sheets in pixels with the maximum-depth heuristic (MDH), the best plane per frame, and a free surface.

    python -m benchmarks.accuracy.sheets --data DIR [--only NAME] [--methods auto,given] [--kinds clean,all,shuffled] [--out FILE]
    python -m benchmarks.accuracy.sheets --table

Uses the sequences of DIR with truth in camera axes and a known focal length. Methods:

- `auto`, `given`: default settings with `image_size`, without and with the focal length
- `free`: the same as `auto` with `surface=free`
- `mdh`: only the conic program of Chhatkuli et al. (TPAMI 2018), with frames weighted as in `isometry.inextensible` and the focal length
  given, on `ANCHORS` points spread over the sheet; not run on spoiled tracks, to which it is not robust
- `plane`: the plane nearest to the true shape in every frame, a lower bound for planar methods

`all` adds 10 % outliers, 30 % hidden observations, noise of 1 px and drift (`benchmarks.accuracy.spoiling`); `shuffled` permutes the
frames. The error is `e3d_frame_scaled`. Each measurement is one JSON line in FILE and is done once.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pliant.solver import Settings, Tracks, solve
from pliant.solver.evaluation.alignment import align
from pliant.solver.isometry.anchors import connected, farthest_points, nearest_neighbours
from pliant.solver.isometry.inextensible import SurfaceGraph, maximum_depth

from benchmarks.accuracy.spoiling import SPOILINGS, spoiled
from benchmarks.rows import append_row, rows
from benchmarks.sequences import Case, cases
from benchmarks.trust import image_size

RESULTS = Path(__file__).parent.parent / "results" / "sheets.jsonl"

FOCAL = {"kinect_paper_dense23": 528.0}
"""Focal lengths, px, of sequences whose `truth.npz` lacks them."""

ANCHORS = 60
"""Number of points of `mdh`, as in the solver's own conic program."""

KINDS = ("clean", "all", "shuffled")


@dataclass(frozen=True, slots=True)
class Sheet:
    """A sequence with its pinhole camera."""

    case: Case
    size: tuple[float, float]
    focal: float

    @property
    def centre(self) -> np.ndarray:
        """The principal point, px: the centre of the picture."""
        return (np.array(self.size) - 1) / 2


def sheets(data: Path, only: list[str]) -> list[Sheet]:
    """Return the sheets of a directory."""
    found = []
    for case in cases(data, points=None, visibility="file", only=only):
        size = image_size(data, case.name)
        if size is None or case.shapes is None:
            continue
        with np.load(data / case.name / "truth.npz") as truth:
            focal = float(truth["focal"]) if "focal" in truth else FOCAL.get(case.name)
        if focal is not None:
            found.append(Sheet(case, size, focal))
    return found


def changed(case: Case, kind: str) -> Case:
    """Return a spoiled or shuffled copy of a sequence."""
    if kind == "shuffled":
        order = np.random.default_rng(0).permutation(case.tracks.num_frames)
        tracks = Tracks.from_arrays(case.tracks.points[order], case.tracks.visible[order])
        return replace(case, tracks=tracks, shapes=None if case.shapes is None else case.shapes[order])
    return replace(case, tracks=spoiled(case.tracks, SPOILINGS[kind]))


def solved(sheet: Sheet, *, given: bool = False, surface: str = "auto") -> dict[str, Any]:
    """Solve a sheet; return the error and the solver's choices."""
    settings = Settings(image_size=sheet.size, focal=sheet.focal if given else None, surface=surface)  # type: ignore[arg-type]
    solution = solve(sheet.case.tracks, sheet.case.mesh, settings=settings)
    focal = solution.camera.focal
    return {
        "error": error(solution.shapes, sheet.case.shapes), "focal_error": None if focal is None else abs(focal / sheet.focal - 1),
        "expected_error": None if solution.trust is None else solution.trust.expected_error,
        "interval": None if solution.trust is None else solution.trust.interval,
        "surface": solution.choices.reasons.get("surface", ""), "verdict": None if solution.trust is None else solution.trust.verdict.value,
    }  # fmt: skip


def maximum_depth_alone(sheet: Sheet) -> dict[str, Any]:
    """Return the error of MDH at the anchors known in every frame, and their number; the error is None if the program fails."""
    points, seen = sheet.case.tracks.points, sheet.case.tracks.visible > 0
    often = np.flatnonzero(seen.mean(axis=0) >= np.quantile(seen.mean(axis=0), 0.5))
    kept = often[farthest_points(points[:, often], seen[:, often], min(ANCHORS, len(often)))]
    anchors = np.where(seen[:, kept, None], points[:, kept], 0.0)
    edges = nearest_neighbours(anchors, seen[:, kept])
    known = connected(seen[:, kept], edges)
    rays = np.concatenate([(anchors - sheet.centre) / sheet.focal, np.ones((*known.shape, 1))], axis=2)
    depths = maximum_depth(SurfaceGraph(rays, known.astype(float), edges))
    assert sheet.case.shapes is not None
    if depths is None:
        return {"error": None}
    whole = known.all(axis=0)
    return {
        "error": error((depths[..., None] * rays)[:, whole], sheet.case.shapes[:, kept[whole]]),
        "points": int(whole.sum()),
    }


def best_plane(sheet: Sheet) -> dict[str, Any]:
    """Return the error of the plane nearest to the true shape in every frame."""
    assert sheet.case.shapes is not None
    values = np.linalg.svd(sheet.case.shapes - sheet.case.shapes.mean(axis=1, keepdims=True), compute_uv=False)
    return {"error": float((values[:, 2] / np.linalg.norm(values, axis=1)).mean())}


def error(shapes: np.ndarray, truth: np.ndarray | None) -> float:
    """Return `e3d_frame_scaled`."""
    assert truth is not None
    return float(align(shapes, truth, kind="frame_scaled").relative.mean())


METHODS: dict[str, Callable[[Sheet], dict[str, Any]]] = {
    "auto": solved,
    "given": lambda sheet: solved(sheet, given=True),
    "free": lambda sheet: solved(sheet, surface="free"),
    "mdh": maximum_depth_alone,
    "plane": best_plane,
}


def table(path: Path) -> str:
    """Return a Markdown table of the errors."""
    found = {(row["sequence"], row["kind"], row["method"]): row for row in rows(path)}
    lines = [
        "| sequence | tracks | " + " | ".join(METHODS) + " | expected, auto | seconds of CPU, auto |",
        "|---" * (len(METHODS) + 4) + "|",
    ]
    for name, kind in dict.fromkeys((name, kind) for name, kind, _ in found):
        default = found.get((name, kind, "auto"), {})
        cells = [found.get((name, kind, method), {}).get("error") for method in METHODS]
        cells.append(default.get("expected_error"))
        shown = ["–" if each is None else f"{each:.4f}".lstrip("0") for each in cells]
        seconds = default.get("cpu_seconds")
        lines.append(
            f"| {name} | {kind} | " + " | ".join(shown) + f" | {'–' if seconds is None else f'{seconds:.0f}'} |"
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Measure what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="directory of recorded sequences")
    parser.add_argument("--only", action="append", default=[], help="names that hold this word")
    parser.add_argument("--methods", default=",".join(METHODS), help="comma-separated: " + ", ".join(METHODS))
    parser.add_argument(
        "--kinds", default=",".join(KINDS), help="comma-separated: clean, shuffled, " + ", ".join(SPOILINGS)
    )
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true", help="only print what was measured")
    given = parser.parse_args(arguments)
    done = {(row["sequence"], row["kind"], row["method"]) for row in rows(given.out)}
    for sheet in [] if given.table or given.data is None else sheets(given.data, given.only):
        for kind, method in ((kind, method) for kind in given.kinds.split(",") for method in given.methods.split(",")):
            fits = kind == "clean" or (method not in ("plane", "mdh")) or (method == "mdh" and kind == "shuffled")
            if (sheet.case.name, kind, method) in done or not fits:
                continue
            began, spent = time.perf_counter(), time.process_time()
            row = METHODS[method](replace(sheet, case=changed(sheet.case, kind)))
            row = {
                "sequence": sheet.case.name, "points": sheet.case.tracks.num_points, "kind": kind, "method": method, **row,
                "seconds": round(time.perf_counter() - began, 1), "cpu_seconds": round(time.process_time() - spent, 1),
            }  # fmt: skip
            append_row(given.out, row)
            print(json.dumps(row), flush=True)
    print(table(given.out))


if __name__ == "__main__":
    main()

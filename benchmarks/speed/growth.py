"""Time and memory against the size of a sequence."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pliant.solver.threads import available_cores

from benchmarks.speed.apart import Measured, apart
from benchmarks.speed.side_by_side import Ours, Workload, run_ours

POINTS = (5_000, 10_000, 30_000, 100_000, 300_000)
"""Numbers of points at `FIXED_FRAMES` frames."""
FRAMES = (10, 25, 50, 100, 200, 400, 800)
"""Numbers of frames at `FIXED_POINTS` points."""
FIXED_FRAMES, FIXED_POINTS = 10, 2_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """Sizes to measure; an empty series is skipped."""

    points: tuple[int, ...] = POINTS
    frames: tuple[int, ...] = FRAMES
    fixed_frames: int = FIXED_FRAMES
    fixed_points: int = FIXED_POINTS

    def series(self) -> list[tuple[str, tuple[int, ...]]]:
        """Return `P` and `F` with their values."""
        return [(name, sizes) for name, sizes in (("P", self.points), ("F", self.frames)) if sizes]

    def at(self, name: str, size: int) -> dict[str, int]:
        """Return frames and points of one measurement."""
        if name == "P":
            return {"frames": self.fixed_frames, "points": size}
        return {"frames": size, "points": self.fixed_points}


def growth(work: Workload, sizes: Sizes, *, results: Path | None, command: str) -> list[str]:
    """Measure; return the lines of the Markdown tables with the fitted exponents.

    Each measurement is appended to the JSON-lines file `results`, if given, with `command`.
    """
    lines: list[str] = []
    for name, values in sizes.series():
        _say(
            lines,
            f"\n| {name} | cameras | shapes (CPU, whole) | iterations | an iteration | peak memory | bytes a F·P |",
        )
        _say(lines, "| --- | --- | --- | --- | --- | --- | --- |")
        done: list[Measured] = []
        for size in values:
            measured = best_of(replace(work, **sizes.at(name, size)))
            done.append(measured)
            _say(lines, f"| {size} {_row(measured)}")
            if results is not None:
                _append(
                    results,
                    {"against": "points" if name == "P" else "frames", **_record(work, measured), "command": command},
                )
        _say(lines, "")
        if len(values) > 1:
            for label, seconds in _series(done).items():
                _say(
                    lines, f"exponent in {name} of {label}: {exponent(np.array(values, float), np.array(seconds)):.2f}"
                )
    return lines


def _record(work: Workload, measured: Measured) -> dict[str, object]:
    """Return a measurement as it is stored in `benchmarks/results/growth.jsonl`."""
    ours: Ours = measured.value
    frames, points = ours.size
    return {
        "points": points, "frames": frames, "prior": work.chosen().prior, "sequence": work.kind,
        "cameras": "true" if work.known else "estimated", "outliers": work.outliers,
        "seconds": round(measured.seconds, 2), "cpu_seconds": round(measured.cpu_seconds, 2),
        "gigabytes": round(measured.peak / 1e9, 2), "silence": round(ours.silence, 2),
        "error": None if ours.error is None else round(ours.error, 5),
        "machine": f"{available_cores()} cores, load {measured.load:.1f}",
    }  # fmt: skip


def _append(results: Path, record: dict[str, object]) -> None:
    with results.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def best_of(work: Workload, *, repeats: int = 3, enough: float = 10.0) -> Measured:
    """Measure up to `repeats` times, or until `enough` seconds have passed; return the run with the least CPU time."""
    taken: list[Measured] = []
    while len(taken) < repeats and sum(each.seconds for each in taken) < enough:
        measured = apart(run_ours, work)
        assert measured is not None, f"{work} ran out of memory"
        taken.append(measured)
    return min(taken, key=lambda each: each.cpu_seconds)


def _series(done: list[Measured]) -> dict[str, list[float]]:
    series = {
        "the whole, wall": [each.seconds for each in done],
        "the whole, CPU": [each.cpu_seconds for each in done],
        "an iteration, wall": [per_iteration(each.value) for each in done],
    }
    if any(each.value.stages["cameras"] > 0.1 for each in done):
        series["the cameras, wall"] = [each.value.stages["cameras"] for each in done]
    return series


def per_iteration(ours: Ours) -> float:
    """Return the seconds of the shape step per iteration of conjugate gradients, reweighting included."""
    return ours.stages["shapes"] / max(ours.iterations, 1)


def _row(measured: Measured) -> str:
    ours: Ours = measured.value
    frames, points = ours.size
    return (
        f"| {ours.stages['cameras']:.2f} s | {ours.stages['shapes']:.2f} s ({measured.cpu_seconds:.2f} s) "
        f"| {ours.iterations} in {ours.reweightings} | {1e3 * per_iteration(ours):.1f} ms "
        f"| {measured.peak / 1e9:.2f} GB | {measured.growth / (frames * points):.0f} |"
    )


def mesh_against_grid(work: Workload) -> list[str]:
    """Compare a triangle mesh with a grid of equal F and P."""
    lines: list[str] = []
    _say(
        lines, "| neighbours | cameras | shapes (CPU, whole) | iterations | an iteration | peak memory | bytes a F·P |"
    )
    _say(lines, "| --- | --- | --- | --- | --- | --- | --- |")
    taken: dict[str, tuple[float, float]] = {}
    for kind in ("grid", "triangles"):
        measured = best_of(replace(work, mesh=kind))
        taken[kind] = measured.value.stages["shapes"], measured.cpu_seconds
        _say(lines, f"| {kind} {_row(measured)}")
    wall, cpu = (mesh / grid for mesh, grid in zip(taken["triangles"], taken["grid"], strict=True))
    _say(lines, f"\nthe mesh takes {wall:.2f} × the grid's time ({cpu:.2f} × its CPU time)")
    return lines


def exponent(sizes: np.ndarray, seconds: np.ndarray) -> float:
    """Return the slope of log time over log size."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def _say(lines: list[str], line: str) -> None:
    print(line, flush=True)
    lines.append(line)

"""Sensitivity of the solver to its constants: small solves with each of them doubled and halved, one at a time.

    python -m benchmarks.accuracy.sensitivity [--only WORD] [--workers N] [--out FILE]
    python -m benchmarks.accuracy.sensitivity --table

Constants are the numbers assigned to upper-case names at the top level of the modules in `ROOMS`. Each solve is one JSON line and is done
only once. Changing a constant that a solve does not use leaves the shapes bit-identical. With one small sequence per case, the table shows
which constants matter at all, not which values are best.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.accuracy.changed_constant import constants_of
from benchmarks.rows import append_row, rows

ROOT = Path(__file__).parent.parent.parent
RESULTS = Path(__file__).parent.parent / "results" / "sensitivity.jsonl"

ROOMS = {
    "solver/cameras": ("face", "face, given cameras"),
    "solver/refinement": ("face", "face, given cameras"),
    "solver/model": ("face", "face, given cameras"),
    "solver/energy": ("face, given cameras",),
    "solver/linear": ("face, given cameras",),
    "solver/operators": ("face, given cameras",),
    "solver/reconstruction": ("face, given cameras",),
    "solver/shapes": ("face, given cameras",),
    "solver/tracks": ("face", "face, given cameras"),
    "solver/isometry": ("sheet",),
}
"""Folders, and the cases in which their constants are changed."""

ELSEWHERE = {
    "bas_relief": ("flag",), "planar_ambiguity": ("flag",), "focal_length": ("face, lens",), "perspective": ("face, lens",),
    "affine_iterations": ("face, lens",), "depth_alternation": ("face, lens",), "depth_rounds": ("face, lens",),
    "resection": ("face, lens",), "completion": ("face, errors",), "noise": ("face, errors",), "observation_model": ("face, errors",),
    "observed": ("face, errors",),
}  # fmt: skip
"""Modules whose constants matter only in other cases."""

FACTORS = (2.0, 0.5)

MATTERS = 1.05
"""Ratio of the errors, in either direction, from which a constant matters."""

PATIENCE = 10.0
"""Processor time allowed to a changed solve, as a multiple of the unchanged solve's; one minute is added."""


class Change(NamedTuple):
    """One solve; an empty name means the unchanged solver."""

    case: str
    module: str = ""
    name: str = ""
    factor: float = 1.0


def constants() -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Yield module, name and cases of every constant."""
    for folder, cases in ROOMS.items():
        for path in sorted((ROOT / folder).glob("*.py")):
            module = ".".join(("pliant", *path.relative_to(ROOT).with_suffix("").parts))
            for statement in ast.parse(path.read_text()).body:
                for name in constants_of(statement):
                    yield module, name, ELSEWHERE.get(path.stem, cases)


def changes(only: list[str]) -> list[Change]:
    """Return the unchanged solves, then those of the constants whose module or name contains one of the words (all without words)."""
    found = [
        Change(case, module, name, factor)
        for module, name, cases in constants()
        if not only or any(word in f"{module}.{name}" for word in only)
        for case in cases
        for factor in FACTORS
    ]
    return [Change(case) for case in dict.fromkeys(change.case for change in found)] + found


def measured(change: Change, seconds: float = 0.0) -> dict[str, Any]:
    """Return the row of one solve, with `refused` if it fails or, when changed, exceeds `seconds` of processor time."""
    command = [sys.executable, "-m", "benchmarks.accuracy.changed_constant", change.case]
    if change.name:
        command += [change.module, change.name, str(change.factor), str(round(seconds))]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode < 0:
        return {**change._asdict(), "refused": "took too long"}
    if done.returncode > 0:
        return {**change._asdict(), "refused": done.stderr.strip().splitlines()[-1][:200]}
    return {**change._asdict(), **json.loads(done.stdout)}


def measure(path: Path, only: list[str], workers: int) -> None:
    """Append the rows of missing solves to a file, running `workers` solves in parallel."""
    done = {_change(row): row for row in rows(path)}
    wanted = [change for change in changes(only) if change not in done]
    for change in (each for each in wanted if not each.name):
        done[change] = measured(change)
        append_row(path, done[change])
    changed = [change for change in wanted if change.name]
    limits = [60 + PATIENCE * done[Change(change.case)]["cpu_seconds"] for change in changed]
    with ThreadPoolExecutor(workers) as pool:
        for row in pool.map(measured, changed, limits):
            append_row(path, row)
            print(json.dumps(row), flush=True)


def _change(row: dict[str, Any]) -> Change:
    return Change(row["case"], row["module"], row["name"], row["factor"])


def table(path: Path) -> str:
    """Return a Markdown table of the constants that matter, with their error and time ratios, and the number of the others."""
    found = rows(path)
    unchanged = {row["case"]: row for row in found if not row["name"]}
    by_constant: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in found:
        if row["name"]:
            by_constant[row["module"].removeprefix("pliant.solver."), row["name"]].append(row)
    lines, unused, harmless = [], 0, 0
    for (module, name), solves in sorted(by_constant.items()):
        ratios = [_ratio(row, unchanged, "e3d_frame_scaled") for row in solves]
        if all(row.get("digest") == unchanged[row["case"]]["digest"] for row in solves):
            unused += 1
        elif all(ratio is not None and 1 / MATTERS < ratio < MATTERS for ratio in ratios):
            harmless += 1
        else:
            cells = [_cell(row, unchanged) for row in sorted(solves, key=lambda row: (row["case"], -row["factor"]))]
            lines.append(f"| `{module}.{name}` | {'; '.join(cells)} |")
    head = (
        f"{len(by_constant)} constants: {unused} leave every bit as it is, {harmless} change the error by less than "
        f"{MATTERS - 1:.0%}, {len(lines)} matter or cannot be changed so far."
    )
    return "\n".join(
        [head, "", "| constant | case: error (time) doubled, halved, over that unchanged |", "|---|---|", *lines]
    )


def _ratio(row: dict[str, Any], unchanged: dict[str, dict[str, Any]], key: str) -> float | None:
    return None if "refused" in row else row[key] / unchanged[row["case"]][key]


def _cell(row: dict[str, Any], unchanged: dict[str, dict[str, Any]]) -> str:
    which = f"{row['case']} ×{row['factor']:g}"
    error, seconds = (_ratio(row, unchanged, key) for key in ("e3d_frame_scaled", "cpu_seconds"))
    return f"{which}: {row['refused']}" if error is None else f"{which}: {error:.2f} ({seconds:.1f})"


def main(arguments: list[str] | None = None) -> None:
    """Measure what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", default=[], help="modules and names that hold this word")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="solves at a time")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--table", action="store_true", help="only print what was measured")
    given = parser.parse_args(arguments)
    if not given.table:
        measure(given.out, given.only, given.workers)
    print(table(given.out))


if __name__ == "__main__":
    main()

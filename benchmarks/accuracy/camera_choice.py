"""Compare `camera=auto` with orthography on recorded sequences, where it should cost nothing without perspective.

    python -m benchmarks.accuracy.camera_choice --data DIR [--only NAME] [--points 300] [--distance 3] [--out FILE]
    python -m benchmarks.accuracy.camera_choice --table

Solves the same tracks with both camera models and appends one JSON line per sequence to FILE: errors, processor seconds, the focal length
if one was found, and whether the shapes are bit-identical. Sequences already in FILE are skipped. `--distance` projects the true shapes
with a pinhole camera that many half-sizes away (`benchmarks.accuracy.distances`), to compare times where perspective is found.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from pliant.solver import Settings, solve
from pliant.solver.evaluation.metrics import e3d_frame

from benchmarks.accuracy.distances import PICTURE, seen_from
from benchmarks.rows import append_row, parser_of, rows
from benchmarks.sequences import Case, cases

RESULTS = Path(__file__).parent.parent / "results" / "camera_choice.jsonl"


def measure(case: Case, *, image_size: tuple[float, float] | None = None) -> dict[str, Any]:
    """Solve a sequence with both camera models and return the row."""
    found: dict[str, Any] = {"sequence": f"{case.name} P={case.tracks.num_points}"}
    shapes = []
    for name, camera in (("orthographic", "scaled_orthographic"), ("auto", "auto")):
        began = time.process_time()
        solution = solve(case.tracks, case.mesh, settings=Settings(camera=camera, image_size=image_size))  # type: ignore[arg-type]
        found[f"seconds_{name}"] = round(time.process_time() - began, 2)
        found[f"e3d_frame_{name}"] = None if case.shapes is None else e3d_frame(solution.shapes, case.shapes)
        shapes.append(solution.shapes)
    return {
        **found, "camera": solution.choices.camera, "focal": solution.camera.focal, "order": solution.choices.reasons["order"],
        "same_bits": shapes[0].tobytes() == shapes[1].tobytes(),
    }  # fmt: skip


def table(path: Path) -> str:
    """Return a Markdown table of the errors and of the ratio of the times."""
    lines = ["| sequence | e3d_frame, orthography | e3d_frame, auto | time ratio | camera |", "|---|---|---|---|---|"]
    for row in rows(path):
        errors = [row["e3d_frame_orthographic"], row["e3d_frame_auto"]]
        shown = ["not known" if each is None else f"{each:.4f}" for each in errors]
        ratio = row["seconds_auto"] / row["seconds_orthographic"]
        same = "; same bits" if row["same_bits"] else ""
        lines.append(f"| {row['sequence']} | {shown[0]} | {shown[1]}{same} | {ratio:.2f} | {row['camera']} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Measure the missing sequences and print the table."""
    parser = parser_of(__doc__, out=RESULTS, points=300)
    parser.add_argument("--distance", help="of a pinhole camera, in half-sizes; the tracks as recorded without it")
    parser.add_argument("--table", action="store_true", help="only print what was measured")
    given = parser.parse_args(arguments)
    done = {row["sequence"] for row in rows(given.out)}
    for case in () if given.table else cases(given.data, points=given.points, visibility="file", only=given.only):
        size = None
        if given.distance is not None:
            if case.shapes is None or case.cameras is None:
                continue
            tracks, shapes, _ = seen_from(case, float(given.distance))
            case, size = replace(case, name=f"{case.name} d={given.distance}", tracks=tracks, shapes=shapes), PICTURE
        if f"{case.name} P={case.tracks.num_points}" not in done:
            row = measure(case, image_size=size)
            append_row(given.out, row)
            print(json.dumps(row), flush=True)
    print(table(given.out))


if __name__ == "__main__":
    main()

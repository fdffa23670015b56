"""Error of the default settings against the share of outliers, the share of hidden points, and the noise: five draws per level.

    python -m benchmarks.accuracy.curves [--data DIR] [--only NAME] [--points N] [--draws N] [--out FILE]

Each solve is one JSON line and is done only once, so the command can be interrupted and restarted. The clean sequence counts as one draw at
level 0. `python -m benchmarks.figures.plots` draws the curves.
"""

from __future__ import annotations

from pathlib import Path

from pliant.solver import solve
from pliant.solver.evaluation.metrics import e3d_frame
from pliant.solver.gallery import corrupt_tracks

from benchmarks.rows import append_row, parser_of, rows
from benchmarks.sequences import Case, cases

LEVELS = {
    "outliers": (0.02, 0.05, 0.1, 0.15, 0.2),
    "hidden": (0.1, 0.2, 0.3, 0.45, 0.6),
    "noise": (0.005, 0.01, 0.02, 0.03, 0.05),
}
"""Arguments of `corrupt_tracks`: shares, and the noise's standard deviation relative to the largest coordinate."""


def main() -> None:
    """Measure the missing draws."""
    parser = parser_of(__doc__, out=Path("benchmarks/results/curves.jsonl"), points=300)
    parser.add_argument("--draws", type=int, default=5)
    given = parser.parse_args()
    done = {(row["sequence"], row["spoiling"], row["level"], row["draw"]) for row in rows(given.out)}
    for case in cases(given.data, points=given.points, visibility="file", only=given.only):
        for draw in range(given.draws):
            for spoiling, level in [("clean", 0.0)] * (draw == 0) + [
                (name, at) for name in LEVELS for at in LEVELS[name]
            ]:
                if (case.name, spoiling, level, draw) not in done:
                    append_row(given.out, _measured(case, spoiling, level, draw))


def _measured(case: Case, spoiling: str, level: float, draw: int) -> dict[str, object]:
    """Solve one draw of a level with estimated cameras."""
    if case.shapes is None:
        raise SystemExit(f"{case.name} has no true shapes.")
    spoiled = {} if spoiling == "clean" else {spoiling: level}
    tracks, _ = corrupt_tracks(case.tracks, **spoiled, seed=draw)
    error = e3d_frame(solve(tracks, case.mesh).shapes, case.shapes)
    print(f"{case.name:24} {spoiling:9} {level:.3f} {error:.4f}", flush=True)
    return {
        "sequence": case.name, "frames": tracks.num_frames, "points": tracks.num_points, "spoiling": spoiling, "level": level, "draw": draw,
        "e3d_frame": error,
    }  # fmt: skip


if __name__ == "__main__":
    main()

"""Accuracy of every method on every sequence, with true and with estimated cameras, clean and corrupted.

    python -m benchmarks.accuracy                          the gallery, clean
    python -m benchmarks.accuracy --data DIR --points 2500  recorded sequences, thinned
    python -m benchmarks.accuracy --data DIR --only face --corruptions all
    python -m benchmarks.accuracy --data DIR --plan        the full table, part by part (see plan.py)
    python -m benchmarks.accuracy --tables                  print what has been measured so far
    python -m benchmarks.accuracy --tables --summary FILE   write mean and spread of every cell, in every metric, as JSON lines
    python -m benchmarks.accuracy --gate                    small gallery sequences against the committed baseline

Each finished cell is one JSON line in `--results`, with its commit. A second run skips finished cells; with `--remeasure`, only those of
the current commit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path

from pliant.solver import InvalidInput

from benchmarks.accuracy import gate
from benchmarks.accuracy.cells import CORRUPTIONS, METHODS, Key, measure, read_rows
from benchmarks.accuracy.plan import PARTS
from benchmarks.accuracy.summary import write_summary
from benchmarks.accuracy.tables import METRICS, clean_table, corruption_table, number
from benchmarks.commit import commit
from benchmarks.rows import append_row, words
from benchmarks.sequences import Case, cases, wanted

SLOW = 10.0
"""Run time, s, above which a corruption gets three trials at most."""

VISIBILITIES = ("file", "all")
"""Visibility from the file, or every point treated as visible."""


def main() -> int:
    """Measure the missing cells, then print the tables."""
    options = _parser().parse_args()
    if options.gate or options.update_baseline:
        return gate.main(update=options.update_baseline)
    if options.plan:
        for part in PARTS:
            measure_all(argparse.Namespace(**{**vars(options), **asdict(part)}))
    elif not options.tables:
        measure_all(options)
    if options.summary is not None:
        write_summary(options.summary, read_rows(options.results).values())
    else:
        print("\n" + tables(options, options.visibility, options.metrics))
    return 0


def measure_all(options: argparse.Namespace) -> None:
    """Measure the missing cells of the selected sequences."""
    for case in cases(options.data, points=options.points, visibility=options.visibility, only=list(options.only)):
        measure_case(case, options)


def measure_case(case: Case, options: argparse.Namespace) -> None:
    """Measure the missing cells of one sequence."""
    seconds: dict[tuple[str, str], float] = {}
    done = read_rows(options.results)
    if options.remeasure:
        done = {key: row for key, row in done.items() if row.get("commit") == commit()}
    for key in keys(case, options):
        if key.trial >= 3 and seconds.get((key.method, key.corruption), 0.0) > SLOW:
            continue
        if key not in done:
            try:
                row = measure(case, key)
            except InvalidInput as error:
                print(f"{case.name:22} {key.method:16} refused: {error}", flush=True)
                continue
            append_row(options.results, row)
            value = number(row["metrics"].get("e3d_frame", float("nan")))
            print(
                f"{case.name:22} {key.method:16} {key.cameras:9} {key.corruption:13} {key.trial} "
                f"e3d_frame {value:>7}  {row['seconds']:.1f} s",
                flush=True,
            )
            done[key] = row
        seconds[key.method, key.corruption] = done[key]["seconds"]


def keys(case: Case, options: argparse.Namespace) -> Iterator[Key]:
    """Yield the cells of one sequence in measuring order."""
    for corruption in CORRUPTIONS:
        if (
            corruption != "clean"
            and "all" not in options.corruptions
            and not wanted(corruption, list(options.corruptions))
        ):
            continue
        if corruption == "clean" and not {"all", "clean"} & set(options.corruptions):
            continue
        for cameras in options.cameras:
            if cameras == "true" and case.cameras is None:
                continue
            for method in options.methods:
                for trial in range(1 if corruption == "clean" else options.trials):
                    yield Key(
                        case.name, case.tracks.num_points, options.visibility, cameras, method, corruption, trial, options.settings
                    )  # fmt: skip


def tables(options: argparse.Namespace, visibility: str, metrics: Iterable[str]) -> str:
    """Return Markdown for the rows that the options select."""
    rows = [
        row
        for row in read_rows(options.results).values()
        if wanted(row["case"], options.only) and row["settings"] == options.settings
        and row["visibility"] == visibility and row["cameras"] in options.cameras and row["method"] in options.methods
    ]  # fmt: skip
    parts = []
    for metric in metrics:
        parts.append(f"### {metric}, clean\n\n{clean_table(rows, metric)}")
        parts += [
            f"### {metric}, corrupted, {cameras} cameras\n\n{corruption_table(rows, metric, cameras)}"
            for cameras in options.cameras
            if any(row["corruption"] != "clean" and row["cameras"] == cameras for row in rows)
        ]
    commits = sorted({str(row.get("commit", "unknown")) for row in rows})
    parts.append(f"{len(rows)} cells, measured at {', '.join(commits) or '–'}")
    return "\n\n".join(parts)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)

    parser.add_argument("--data", type=Path, help="directory of sequences; the gallery when not given")
    parser.add_argument("--points", type=int, help="thin every sequence to so many points, keeping a mesh")
    parser.add_argument("--visibility", choices=VISIBILITIES, default="file", help="all: take hidden points as seen")
    parser.add_argument("--only", type=words, default=[], help="sequences whose name holds one of these words")
    parser.add_argument("--methods", type=words, default=list(METHODS))
    parser.add_argument("--cameras", type=words, default=["true", "estimated"])
    parser.add_argument("--corruptions", type=words, default=["clean"], help="clean, all, or words: noise,outliers,…")
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--settings", default="", help="further settings, name=value,…")
    parser.add_argument("--results", type=Path, default=Path("build/benchmarks/accuracy.jsonl"))
    parser.add_argument("--metrics", type=words, default=["e3d_frame"], help="of: " + ", ".join(METRICS))
    parser.add_argument("--plan", action="store_true", help="the whole table of the recorded sequences; needs --data")
    parser.add_argument("--remeasure", action="store_true", help="measure cells of other commits anew")
    parser.add_argument("--tables", action="store_true", help="measure nothing")
    parser.add_argument(
        "--summary", type=Path, help="write mean and spread of every cell and metric to this JSON-lines file"
    )
    parser.add_argument("--gate", action="store_true", help="exit 1 if a small sequence got worse than the baseline")
    parser.add_argument("--update-baseline", action="store_true", help="rewrite the baseline")
    return parser


if __name__ == "__main__":
    sys.exit(main())

"""Markdown tables of measured cells."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import numpy as np

from benchmarks.accuracy.cells import CORRUPTIONS, METHODS

METRICS = (
    "e3d_frame", "e3d_sequence", "e3d_frame_similarity", "e3d_mocap", "rotation_degrees", "reprojection_median",
    "reprojection_rms",
)  # fmt: skip

Rows = Iterable[dict[str, Any]]


def clean_table(rows: Rows, metric: str) -> str:
    """Return the clean results: a row per sequence, a column per camera source and method."""
    found = [row for row in rows if row["corruption"] == "clean" and metric in row["metrics"]]
    columns = [(cameras, method) for cameras in ("true", "estimated") for method in METHODS]
    columns = [column for column in columns if any(_column(row) == column for row in found)]
    head = ["sequence", *(f"{method}, {cameras}" for cameras, method in columns)]
    if metric == "e3d_frame":
        head += ["K", "seconds"]
    body = []
    for sequence in _ordered(found):
        cells = {_column(row): row for row in found if _name(row) == sequence}
        line = [sequence, *(number(cells[c]["metrics"][metric]) if c in cells else "–" for c in columns)]
        if metric == "e3d_frame":
            last = cells.get(columns[-1], next(iter(cells.values())))
            line += [str(last["chosen"]["basis_size"]), f"{last['seconds']:.1f}"]
        body.append(line)
    return _markdown(head, body)


def corruption_table(rows: Rows, metric: str, cameras: str) -> str:
    """Return mean ± standard deviation over the trials: a row per sequence and corruption, a column per method."""
    found = [row for row in rows if row["cameras"] == cameras and metric in row["metrics"]]
    groups: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for row in found:
        groups[_name(row), row["corruption"], row["method"]].append(row["metrics"][metric])
    spoilt = {sequence for sequence, corruption, _ in groups if corruption != "clean"}
    methods = [method for method in METHODS if any(key[2] == method and key[0] in spoilt for key in groups)]
    body = []
    for sequence in _ordered(found):
        for corruption in CORRUPTIONS:
            values = [groups.get((sequence, corruption, method), []) for method in methods]
            if sequence in spoilt and any(values):
                trials = str(max(len(v) for v in values))
                body.append([sequence, corruption, trials, *(_spread(v) for v in values)])
    return _markdown(["sequence", "corruption", "trials", *methods], body)


def number(value: float) -> str:
    """Format three significant digits in the field's style: .0341, 1.25, 12.5; a dash if not finite."""
    if value == 0 or not np.isfinite(value):
        return "0" if value == 0 else "–"
    digits = max(0, 2 - int(np.floor(np.log10(abs(value)))))
    text = f"{value:.{min(digits, 5)}f}"
    return text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text


def _spread(values: list[float]) -> str:
    if not values:
        return "–"
    mean = number(float(np.mean(values)))
    return mean if len(values) == 1 else f"{mean} ± {number(float(np.std(values, ddof=1)))}"


def _column(row: dict[str, Any]) -> tuple[str, str]:
    return row["cameras"], row["method"]


def _name(row: dict[str, Any]) -> str:
    return f"{row['case']}, {row['frames']} × {row['points']}"


def _ordered(rows: list[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(_name(row) for row in rows))


def _markdown(head: list[str], body: list[list[str]]) -> str:
    if not body:
        return "(nothing measured)"
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)

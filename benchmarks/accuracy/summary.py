"""Summarise measured cells over their trials: one JSON line per cell and metric, committed in `benchmarks/results`."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rows import machine

FIELDS = ("case", "frames", "points", "visibility", "cameras", "corruption", "method")


def write_summary(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Write mean and standard deviation of every metric, and mean seconds, over the trials; skip cells with extra settings."""
    cells: dict[tuple[Any, ...], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        if not row["settings"]:
            cells[tuple(row[name] for name in FIELDS)].append(row)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        for key, trials in cells.items():
            for record in summarised(dict(zip(("sequence", *FIELDS[1:]), key, strict=True)), trials):
                file.write(json.dumps(record, ensure_ascii=False) + "\n")


def summarised(cell: dict[str, Any], trials: list[dict[str, Any]]) -> Iterable[dict[str, Any]]:
    """Yield one record per metric of a cell's trials."""
    for metric in dict.fromkeys(name for trial in trials for name in trial["metrics"]):
        values = [trial["metrics"][metric] for trial in trials if metric in trial["metrics"]]
        record = {**cell, "metric": metric, "mean": float(np.mean(values)), "trials": len(values)}
        if len(values) > 1:
            record["std"] = float(np.std(values, ddof=1))
        record["seconds"] = round(float(np.mean([trial["seconds"] for trial in trials])), 1)
        record["machine"] = machine()
        record["commit"] = trials[-1]["commit"]
        yield record

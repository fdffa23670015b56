"""Cells of the accuracy table: each measurement is one JSON line, so that an interrupted table can be resumed."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pliant.solver import Settings, solve
from pliant.solver.evaluation.metrics import evaluate
from pliant.solver.gallery import corrupt_tracks

from benchmarks.commit import commit
from benchmarks.rows import rows
from benchmarks.sequences import Case

METHODS: dict[str, dict[str, str]] = {
    "pseudo_inverse": {"method": "pseudo_inverse", "prior": "smooth"},
    "temporal": {"method": "temporal", "prior": "smooth"},
    "spatio_temporal": {"method": "spatio_temporal", "prior": "smooth"},
    "robust": {"method": "robust", "prior": "smooth"},
    "robust+low_rank": {"method": "robust", "prior": "smooth+low_rank"},
    "default": {},
}
"""Settings of each method; `default` changes none, and its cells name the prior in `chosen`."""

CORRUPTIONS: dict[str, dict[str, float]] = {
    "clean": {},
    "noise .01": {"noise": 0.01},
    "noise .03": {"noise": 0.03},
    "noise .05": {"noise": 0.05},
    "outliers 2 %": {"outliers": 0.02},
    "outliers 6 %": {"outliers": 0.06},
    "outliers 10 %": {"outliers": 0.10},
    "hidden 30 %": {"hidden": 0.30},
    "both": {"noise": 0.01, "outliers": 0.05, "hidden": 0.20},
}
"""Arguments of `corrupt_tracks`; `both` combines 5 % outliers, 20 % hidden and noise of r = .01."""


@dataclass(frozen=True, slots=True)
class Key:
    """Identity of a cell."""

    case: str
    points: int
    visibility: str
    cameras: str
    """`true` or `estimated`."""
    method: str
    corruption: str
    trial: int
    settings: str = ""
    """Additional settings, as `name=value,…`."""


def measure(case: Case, key: Key) -> dict[str, Any]:
    """Corrupt and solve one sequence; return the row of its metrics."""
    tracks, _ = corrupt_tracks(case.tracks, **CORRUPTIONS[key.corruption], seed=key.trial)
    settings = replace(Settings(), **METHODS[key.method], **parse_settings(key.settings))  # type: ignore[arg-type]
    cameras = case.cameras if key.cameras == "true" else None
    wall, cpu = time.perf_counter(), time.process_time()
    solution = solve(tracks, case.mesh, cameras=cameras, settings=settings)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    rotations = None if case.cameras is None else case.cameras.rotations
    metrics = evaluate(solution, tracks, case.shapes, rotations)
    if rotations is None:
        # Each frame's truth is then in its own camera axes, so metrics with one transform per sequence are meaningless.
        metrics = {name: value for name, value in metrics.items() if name not in ("e3d_sequence", "e3d_mocap")}
    choices = solution.choices
    chosen = {
        name: getattr(choices, name)
        for name in (
            "basis_size",
            "temporal_weight",
            "spatial_weight",
            "robust_scale",
            "temporal_order",
            "low_rank_weight",
        )
    }
    chosen["prior"] = settings.prior
    return {
        **asdict(key),
        "frames": tracks.num_frames,
        "commit": commit(),
        "metrics": metrics,
        "chosen": chosen,
        "warnings": list(choices.warnings),
        "outcome": str(solution.outcome),
        "iterations": int(np.sum(solution.trace.iterations)),
        "reweightings": len(solution.trace.objective) - 1,
        "seconds": wall,
        "cpu_seconds": cpu,
        "stages": {stage: round(seconds, 3) for stage, seconds in solution.seconds.items()},
    }


def parse_settings(text: str) -> dict[str, Any]:
    """Parse `name=value,…`; values that are neither JSON nor True, False or None stay strings."""
    values: dict[str, Any] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        try:
            values[name] = json.loads(value.replace("True", "true").replace("False", "false").replace("None", "null"))
        except json.JSONDecodeError:
            values[name] = value
    return values


def key_of(row: dict[str, Any]) -> Key:
    """Rebuild the key of a stored row."""
    return Key(**{name: row[name] for name in Key.__dataclass_fields__})


def read_rows(path: Path) -> dict[Key, dict[str, Any]]:
    """Read finished cells; truncated lines are skipped, so that their cells are measured again."""
    return {key_of(row): row for row in rows(path)}

"""Accuracy on small gallery sequences against a committed baseline: numbers that do not depend on the machine."""

from __future__ import annotations

import json
from pathlib import Path

from pliant.solver.gallery import face, flag, sphere

from benchmarks.accuracy.cells import METHODS, Key, measure
from benchmarks.commit import commit
from benchmarks.sequences import from_gallery

BASELINE = Path(__file__).parent / "baseline.json"
RELATIVE, ABSOLUTE = 0.05, 0.001
"""A metric may exceed its baseline by 5 % and .001 together; beyond that it is a regression."""
METRICS = ("e3d_frame", "e3d_sequence")

SMALL = {
    "face": lambda: face(24, 400, scale_change=0.05),
    "flag": lambda: flag(24, 300),
    "sphere": lambda: sphere(24, 300),
}


def main(*, update: bool) -> int:
    """Measure; write the baseline or compare with it. Returns 1 if something got worse."""
    measured = measure_all()
    if update:
        BASELINE.write_text(json.dumps({"commit": commit(), "numbers": measured}, indent=1, sort_keys=True) + "\n")
        print(f"wrote {len(measured)} numbers to {BASELINE}")
        return 0
    kept = json.loads(BASELINE.read_text())
    baseline = kept["numbers"]
    worse = regressions(measured, baseline)
    for name in sorted(measured):
        print(
            f"{'WORSE' if name in worse else 'ok':6}{name:60}{measured[name]:.5f}  baseline {baseline.get(name, float('nan')):.5f}"
        )
    missing = sorted(set(baseline) - set(measured))
    if missing:
        print("not measured any more: " + ", ".join(missing))
    print(f"{len(worse)} of {len(measured)} worse than the baseline of {kept['commit']}")
    return 1 if worse or missing else 0


def measure_all() -> dict[str, float]:
    """Every small sequence × cameras × method, clean, and the robust ones with outliers, noise and hidden points."""
    numbers = {}
    for name, make in SMALL.items():
        case = from_gallery(make(), name)
        for cameras in ("true", "estimated"):
            for method in METHODS:
                for corruption in ("clean", "both") if method in ("robust", "default") else ("clean",):
                    row = measure(case, Key(name, case.tracks.num_points, "file", cameras, method, corruption, 0))
                    for metric in METRICS:
                        numbers[f"{name} / {corruption} / {cameras} / {method} / {metric}"] = round(
                            row["metrics"][metric], 5
                        )
    return numbers


def regressions(measured: dict[str, float], baseline: dict[str, float]) -> set[str]:
    """Names of the numbers that exceed the baseline by more than the tolerance."""
    return {
        name
        for name, value in measured.items()
        if name in baseline and value > baseline[name] * (1 + RELATIVE) + ABSOLUTE
    }

"""Compare accuracy on small gallery sequences with a committed baseline; the figures do not depend on the machine."""

from __future__ import annotations

import json
from pathlib import Path

from pliant.solver.gallery import face, flag, sphere

from benchmarks.accuracy.cells import METHODS, Key, measure
from benchmarks.commit import commit
from benchmarks.sequences import from_gallery

BASELINE = Path(__file__).parent / "baseline.json"
RELATIVE, ABSOLUTE = 0.05, 0.001
"""A metric above 1.05 times its baseline plus .001 is a regression."""
METRICS = ("e3d_frame", "e3d_sequence")

SMALL = {
    "face": lambda: face(24, 400, scale_change=0.05),
    "flag": lambda: flag(24, 300),
    "sphere": lambda: sphere(24, 300),
}


def main(*, update: bool) -> int:
    """Write the baseline or compare with it; return 1 if a metric got worse or is missing."""
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
    """Measure every small sequence, camera source and method; `robust` and `default` also with corruption `both`."""
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
    """Return the names of the metrics that exceed their baseline by more than the tolerance."""
    return {
        name
        for name, value in measured.items()
        if name in baseline and value > baseline[name] * (1 + RELATIVE) + ABSOLUTE
    }

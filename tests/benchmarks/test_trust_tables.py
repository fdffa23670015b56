"""Coverage from quantiles, pooled over sequences, and the table of real sheets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks.sequences import rolled_sheet


def solve_of(name: str, *, too_small: float, kind: str = "clean", count: int = 99) -> dict:
    """Return a solve with normal errors whose standard deviation is `too_small` times the stated one."""
    levels = np.arange(1, count + 1) / (count + 1)
    return {
        "sequence": name, "kind": kind, "true": 0.1, "interval": [0.05, 0.2],
        "quantiles": (too_small * norm.ppf((1 + levels) / 2)).tolist(),
    }  # fmt: skip


@pytest.mark.parametrize("count", [19, 99])
def test_coverage_follows_from_quantiles(bench, count: int) -> None:
    tables = bench("trust_tables")
    row = solve_of("one", too_small=2.0, count=count)
    assert tables.within(row, 2 * 1.645) == pytest.approx(0.9, abs=1e-3)
    assert tables.within(row, 2 * 0.6745) == pytest.approx(0.5, abs=1e-3)
    assert tables.within(row, 1e6) == pytest.approx(1, abs=0.03)
    assert tables.within({"sequence": "none"}) is None


def test_pooling_weights_sequences_equally_whatever_their_solve_count(bench) -> None:
    tables = bench("trust_tables")
    often = [solve_of("often", too_small=1.0, kind=str(number)) for number in range(5)]
    often.append(solve_of("often with image_size", too_small=1.0))
    rows = [*often, solve_of("once", too_small=4.0)]
    expected = (tables.within(often[0], 1.645) + tables.within(rows[-1], 1.645)) / 2
    assert tables.pooled(rows, 1.645) == pytest.approx(expected)
    assert "once clean" in tables.exceptions([*often, solve_of("once", too_small=20.0)])
    assert "no solve" in tables.exceptions(often)


def test_the_table_of_warning_signs_counts_solves_by_true_error(bench) -> None:
    tables = bench("trust_tables")
    turns = {"degrees_per_frame": 1.0, "deformation_per_frame": 0.1}
    rows = [
        {"sequence": "a", "true": 0.01, "held_out": 0.01, "degrees_per_frame": 9.0, "deformation_per_frame": 0.1},
        {"sequence": "b", "true": 0.2, "held_out": 0.09, **turns},
        {"sequence": "b", "true": 0.1, "held_out": None, **turns},
        {"sequence": "noise", "true": None, "held_out": 0.7, "degrees_per_frame": None, "deformation_per_frame": None},
    ]
    assert [tables.misses_held_out(row) for row in rows] == [False, True, None, True]
    assert [tables.turns_slowly(row) for row in rows] == [False, True, True, None]
    held_out, turn = tables.separated(rows[:0], rows).splitlines()[3::2]
    assert held_out.endswith("| others | 0 of 1 | 0 of 0 | 1 of 1 | 1 of 1 |")
    assert turn.endswith("| others | 0 of 1 | 1 of 1 | 1 of 1 | 0 of 0 |")
    assert tables.separated([], [{"sequence": "of an older solver", "true": 0.1}]) == ""


def test_the_committed_solves_obey_the_verdict_rules() -> None:
    """A true error above .15 is never `good`; one below .03 is `do_not_use` in one known case only (`docs/explanation/trust.md`)."""
    file = Path(__file__).parents[2] / "benchmarks" / "results" / "trust.jsonl"
    solves = [json.loads(line) for line in file.read_text().splitlines()]
    known = [solve for solve in solves if solve["true"] is not None and np.isfinite(solve["true"])]
    assert len(known) > 60
    verdicts = {(solve["sequence"], solve["kind"]): (solve["true"], solve["verdict"]) for solve in known}
    assert {which for which, (true, verdict) in verdicts.items() if true > 0.15 and verdict == "good"} == set()
    false_alarms = {which for which, (true, verdict) in verdicts.items() if true < 0.03 and verdict == "do_not_use"}
    assert false_alarms == set()


def recorded_sheet(folder: Path) -> None:
    """Write the rolled sheet as a recorded sequence."""
    sheet = rolled_sheet()
    (folder / "rolled").mkdir(parents=True)
    np.savez(folder / "rolled" / "tracks.npz", tracks=sheet.tracks.points)
    np.savez(folder / "rolled" / "truth.npz", shapes=sheet.shapes, focal=600.0)
    (folder / "rolled" / "about.json").write_text(json.dumps({"units": "pixels", "image_size": [640, 480]}))


@pytest.mark.slow
def test_other_methods_on_a_sheet_are_measured_once_and_tabulated(bench, tmp_path, capsys) -> None:
    sheets = bench("accuracy.sheets")
    recorded_sheet(tmp_path / "data")
    out = tmp_path / "sheets.jsonl"
    given = [
        "--data",
        str(tmp_path / "data"),
        "--methods",
        "plane,mdh",
        "--kinds",
        "clean,shuffled,all",
        "--out",
        str(out),
    ]
    sheets.main(given)
    found = {(row["method"], row["kind"]): row["error"] for row in map(json.loads, out.read_text().splitlines())}
    assert set(found) == {("plane", "clean"), ("mdh", "clean"), ("mdh", "shuffled")}
    assert found["mdh", "clean"] < 0.5 * found["plane", "clean"]
    assert found["mdh", "shuffled"] == pytest.approx(found["mdh", "clean"], rel=0.05)
    first = out.read_text()
    sheets.main(given)
    assert out.read_text() == first
    assert "| rolled | clean | – | – | – |" in capsys.readouterr().out


def test_reconstructions_by_other_methods_are_not_ground_truth(bench) -> None:
    tables = bench("trust_tables")
    solves = [{**solve_of(name, too_small=1.0), "verdict": "good", "true": 0.01} for name in ("one", "dinosaur_real")]
    found = tables.confusion("Others", tables.with_truth(solves))
    assert "| below .03 | 1 | 0 | 0 |" in found

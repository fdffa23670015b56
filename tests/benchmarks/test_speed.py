"""The speed benchmarks at tiny sizes: timing, memory limits, and arithmetic."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from holding import hold

ROOT = Path(__file__).parent.parent.parent


def speed(*arguments: str) -> list[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "benchmarks.speed", *arguments]
    ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=200, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.splitlines()


@pytest.mark.long
@pytest.mark.slow
def test_every_baseline_is_timed_beside_the_solver():
    lines = speed("compare", "--frames", "6", "--points", "80", "--cap", "60")
    cells = {
        line.split("|")[1].strip(): [cell.strip() for cell in line.split("|")[2:-1]] for line in lines if "|" in line
    }
    assert {
        "ours, within 1 %, whole",
        "ours, within 1 %, from the start",
        "ours, to the end",
        "conjugate gradients",
        "gradient descent",
        "direct",
    } <= set(cells)
    for name in ("conjugate gradients", "gradient descent", "direct"):
        energy, seconds, times, from_start, iterations, memory = cells[name]
        assert 0.9 < float(energy) <= 1.011
        assert float(seconds.split()[0]) >= 0
        assert float(times.split()[0]) >= 0
        assert float(from_start.split()[0]) >= float(times.split()[0])
        assert int(iterations) > 0
        assert 0.02 < float(memory.split()[0]) < 2


@pytest.mark.long
@pytest.mark.slow
def test_growth_prints_a_row_per_size_and_the_exponents():
    lines = speed("growth", "--against-points", "100,200", "--against-frames", "4,8")
    assert sum(line.startswith(("| 100 ", "| 200 ", "| 4 ", "| 8 ")) for line in lines) == 4
    assert sum(line.startswith("exponent in P of") for line in lines) == 3
    assert sum(line.startswith("exponent in F of") for line in lines) == 3


@pytest.mark.long
@pytest.mark.slow
def test_measurements_of_growth_are_appended_to_a_file(tmp_path):
    results = tmp_path / "growth.jsonl"
    results.write_text('{"measured": "before"}\n')
    speed(
        "growth", "--kind", "face", "--cameras", "true", "--settings", "prior=smooth", "--outliers", "0",
        "--against-points", "", "--against-frames", "5", "--fixed-points", "40", "--results", str(results),
    )  # fmt: skip
    before, row = (json.loads(line) for line in results.read_text().splitlines())
    assert before == {"measured": "before"}
    named = tuple(row[name] for name in ("against", "frames", "points", "sequence", "cameras"))
    assert named == ("frames", 5, 40, "face", "true")
    assert 0 <= row["silence"] <= row["seconds"]
    assert row["gigabytes"] > 0.02
    assert row["command"].startswith("python -m benchmarks.speed growth --kind face")
    assert "results" not in row["command"]


@pytest.mark.slow
@pytest.mark.long
def test_a_mesh_is_timed_against_a_grid():
    assert any("× the grid's time" in line for line in speed("mesh", "--frames", "6", "--points", "100"))


def test_a_large_solve_keeps_its_result_in_the_scratch_folder(bench, tmp_path, monkeypatch):
    monkeypatch.setattr("pliant.solver.reconstruction.blocks.BLOCK_OBSERVATIONS", 100)
    side_by_side = bench("speed.side_by_side")
    solved, places = side_by_side.solve, []

    def watched(*arguments, **options):
        solution = solved(*arguments, **options)
        if options.get("scratch"):
            places.append((options["scratch"], isinstance(solution.shapes.base, np.memmap)))
        return solution

    monkeypatch.setattr(side_by_side, "solve", watched)
    work = side_by_side.Workload(frames=4, points=60, outliers=0.0, scratch=tmp_path)
    side_by_side.run_ours(bench("speed.apart").Stopwatch(), work)
    assert places == [(tmp_path, True)]


def test_the_exponent_of_a_power_law_is_recovered(bench):
    sizes = np.array([10.0, 20.0, 80.0])
    assert bench("speed.growth").exponent(sizes, 3 * sizes**1.25) == pytest.approx(1.25)


def test_the_memory_growth_of_a_child_process_is_measured(bench):
    measured = bench("speed.apart").apart(hold, 200_000_000)
    assert measured.value == 25_000_000
    assert 190e6 < measured.growth < 230e6
    assert measured.peak > measured.growth


def test_running_out_of_memory_returns_none(bench):
    assert bench("speed.apart").apart(hold, 1 << 40, limit=1 << 32) is None


def test_an_unfinished_run_is_extrapolated_at_its_last_rate(bench):
    """The gap halves every second: from 64 % to 1 % in six."""
    run = bench("speed.baselines").Run([0.0, 1.0, 2.0], [1.64, 1.32, 1.16])
    assert bench("speed.side_by_side").extrapolated(run, best=1.0) == pytest.approx(6.0)
    stuck = bench("speed.baselines").Run([0.0, 1.0, 2.0], [1.64, 1.64, 1.64])
    assert bench("speed.side_by_side").extrapolated(stuck, best=1.0) == float("inf")

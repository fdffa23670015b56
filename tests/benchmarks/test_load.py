"""The load benchmark at a tiny size: real processes, no losses, memory reported."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc"),
    pytest.mark.slow,
]


@pytest.mark.long
def test_the_load_loses_nothing_and_prints_its_tables() -> None:
    tiny = ["--jobs", "4", "--clients", "2", "--pollers", "20", "--seconds", "2", "--every", "1", "--megabytes", "70"]
    ran = subprocess.run(
        [sys.executable, "-m", "benchmarks.installation.load", *tiny],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False, timeout=240,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert ran.stdout.count("| lost | 0 |") == 3
    assert "the stores are consistent with the job records" in ran.stdout
    figures = ran.stdout.split("API memory before / at most while it arrives / at most until accepted | ")[1]
    before, arriving, accepted = (int(word) for word in figures.split(" MB")[0].split(" / "))
    assert 0 < before <= arriving <= accepted < before + 100, "the inputs are read in a process of their own"

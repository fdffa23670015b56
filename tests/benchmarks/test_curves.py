"""Error as a function of corruption: every draw is solved once."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks.accuracy import curves


@pytest.mark.slow
@pytest.mark.long
def test_every_draw_is_solved_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(curves, "LEVELS", {"outliers": (0.1,), "noise": (0.05,)})
    out = tmp_path / "curves.jsonl"
    command = ["curves", "--only", "face_few_frames", "--points", "40", "--draws", "2", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", command)
    curves.main()
    curves.main()
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["spoiling"], row["draw"]) for row in rows] == [
        ("clean", 0), ("outliers", 0), ("noise", 0), ("outliers", 1), ("noise", 1),
    ]  # fmt: skip
    errors = {(row["spoiling"], row["draw"]): row["e3d_frame"] for row in rows}
    assert errors["clean", 0] < errors["noise", 0]
    assert errors["noise", 0] != errors["noise", 1]

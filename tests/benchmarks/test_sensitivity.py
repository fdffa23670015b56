"""Constants doubled and halved: what is changed, and that derived values follow."""

from __future__ import annotations

import ast
import importlib
import json
import sys
from pathlib import Path

import pytest

from benchmarks.accuracy import sensitivity
from benchmarks.accuracy.changed_constant import ChangedConstant, changed, multiplied

SOURCE = '''
WEIGHT = 0.5
"""Of the penalty."""
ROUNDS, SHARES = 7, (0.1, 0.2)
FLOOR: float = -WEIGHT + 1e-3
UNIT = "rad"
lower = 3.0
'''


@pytest.mark.parametrize(
    ("name", "factor", "expected"),
    [
        ("WEIGHT", 2.0, {"WEIGHT": 1.0, "FLOOR": -0.999}),
        ("ROUNDS", 0.5, {"ROUNDS": 4, "SHARES": (0.1, 0.2)}),
        ("SHARES", 2.0, {"ROUNDS": 7, "SHARES": (0.2, 0.4)}),
        ("FLOOR", 2.0, {"WEIGHT": 0.5, "FLOOR": -0.498}),
    ],
)
def test_a_changed_constant_propagates_to_values_derived_from_it(
    name: str, factor: float, expected: dict[str, object]
) -> None:
    module: dict[str, object] = {}
    exec(compile(changed(ast.parse(SOURCE), name, factor), "module", "exec"), module)
    assert {key: module[key] for key in expected} == expected


@pytest.mark.parametrize("name", ["UNIT", "lower", "MISSING"])
def test_only_upper_case_numbers_count_as_constants(name: str) -> None:
    with pytest.raises(LookupError, match=f"assigns no number to {name}"):
        changed(ast.parse(SOURCE), name, 2.0)


def test_multiplied_integers_stay_integers_and_counts_stay_positive() -> None:
    assert [multiplied(value, 0.5) for value in (8, 1, 0, -3, 3.0)] == [4, 1, 0, -3, 1.5]


def test_a_module_is_imported_with_the_change(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "measured_room.py").write_text("STEP = 0.25\nTWICE = 2 * STEP\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("measured_room")  # its byte code is on disk now
    monkeypatch.delitem(sys.modules, "measured_room")
    monkeypatch.setattr(sys, "meta_path", [ChangedConstant("measured_room", "STEP", 2.0), *sys.meta_path])
    module = importlib.import_module("measured_room")
    monkeypatch.delitem(sys.modules, "measured_room")
    assert (module.STEP, module.TWICE) == (0.5, 1.0)


def test_every_folder_and_module_named_has_constants() -> None:
    found = [(module, cases) for module, _, cases in sensitivity.constants()]
    rooms = {module.split(".")[2] for module, _ in found}
    assert rooms == {folder.split("/")[1] for folder in sensitivity.ROOMS}
    assert {module.rsplit(".", 1)[1] for module, _ in found} >= set(sensitivity.ELSEWHERE)


@pytest.mark.long
@pytest.mark.slow
def test_each_solve_runs_once_and_the_table_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sensitivity.jsonl"
    command = ["--only", "hyperparameters.BENDING_SHARE", "--workers", "1", "--out", str(out)]
    sensitivity.main(command)
    lines = out.read_text().splitlines()
    sensitivity.main(command)
    assert out.read_text().splitlines() == lines
    solves = [json.loads(line) for line in lines]
    assert sorted(row["factor"] for row in solves if row["name"] == "BENDING_SHARE") == [0.5, 2.0]
    unchanged = {row["case"]: row["digest"] for row in solves if not row["name"]}
    assert any(row["digest"] != unchanged[row["case"]] for row in solves)
    assert capsys.readouterr().out.count("1 constants:") == 2


def test_a_change_that_cannot_be_applied_is_reported() -> None:
    refused = sensitivity.measured(
        sensitivity.Change("face, given cameras", "pliant.solver.model.so3", "MISSING", 2.0), 60
    )
    assert "assigns no number to MISSING" in refused["refused"]

"""The pace of the machine: measured against planned processor time."""

import numpy as np
import pytest
from pliant.solver import pace
from pliant.solver.gallery import face
from pliant.solver.pace import PIECE_SECONDS, PIECES, MachinePace
from pliant.solver.reconstruct import solve
from pliant.solver.records import Step


def test_the_pace_is_the_measured_time_over_the_planned_one_averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(np.array([0, 2, 10, 14]) * PIECES * PIECE_SECONDS)
    monkeypatch.setattr(pace.time, "thread_time", lambda: float(next(clock)))
    machine = MachinePace()
    assert machine.measure() == pytest.approx(2)
    assert machine.measure() == pytest.approx((2 + 4) / 2)


def test_a_machine_has_a_pace() -> None:
    assert 0.02 < MachinePace().measure() < 200


def test_a_solve_on_a_slower_machine_is_expected_to_take_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    def first_estimate(measured: float) -> float:
        monkeypatch.setattr(MachinePace, "measure", lambda self: measured)
        steps: list[Step] = []
        solve(face(8, 40).tracks, on_step=steps.append, should_stop=lambda: True)
        assert steps[0].seconds_left is not None
        return steps[0].seconds_left

    assert first_estimate(4.0) > 2 * first_estimate(1.0)

"""The pace of the machine: measured against planned processor time."""

import numpy as np
import pytest
from pliant.worker.execution import pace
from pliant.worker.execution.pace import PIECE_SECONDS, PIECES, MachinePace


def test_the_pace_is_the_mean_ratio_of_measured_to_planned_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(np.array([0, 2, 10, 14]) * PIECES * PIECE_SECONDS)
    monkeypatch.setattr(pace.time, "thread_time", lambda: float(next(clock)))
    machine = MachinePace()
    assert machine.measure() == pytest.approx(2)
    assert machine.measure() == pytest.approx((2 + 4) / 2)


def test_this_machine_has_a_plausible_pace() -> None:
    assert 0.02 < MachinePace().measure() < 200

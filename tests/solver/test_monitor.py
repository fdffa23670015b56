"""Progress never falls and keeps moving; a stop at any question ends the solve as stopped, with finite shapes."""

from __future__ import annotations

import numpy as np
import pytest
from pliant.solver import Outcome, Settings, Step, Tracks, gallery, solve
from pliant.solver.monitor import Monitor


def small(*, noisy: bool = False) -> Tracks:
    tracks = gallery.face(7, 24, degrees=60).tracks
    points = np.array(tracks.points)
    if noisy:
        points[2, 5] += 3.0
    return Tracks.from_arrays(points)


def questions(tracks: Tracks, settings: Settings) -> int:
    asked = 0

    def never() -> bool:
        nonlocal asked
        asked += 1
        return False

    assert solve(tracks, settings=settings, should_stop=never).outcome is not Outcome.STOPPED
    return asked


def stopped_at(tracks: Tracks, settings: Settings, number: int) -> None:
    asked = 0

    def from_then_on() -> bool:
        nonlocal asked
        asked += 1
        return asked >= number

    found = solve(tracks, settings=settings, should_stop=from_then_on)
    assert found.outcome is Outcome.STOPPED, number
    assert asked == number, "a stop is not asked for twice"
    assert np.isfinite(found.shapes).all()
    assert np.isfinite(found.camera.rotations).all()


def test_a_stop_during_the_smooth_prior_is_reported() -> None:
    tracks, settings = small(), Settings(prior="smooth", refine_rotations=False)
    for number in np.linspace(1, questions(tracks, settings), 6).astype(int):
        stopped_at(tracks, settings, number)


def test_a_stop_during_the_default_is_reported() -> None:
    for number in (1, 2, 40, 400):
        stopped_at(small(noisy=True), Settings(), number)


@pytest.mark.slow
@pytest.mark.parametrize("noisy", [False, True])
def test_a_stop_in_every_stage_is_reported(noisy: bool) -> None:
    tracks, settings = small(noisy=noisy), Settings()
    for number in np.linspace(1, questions(tracks, settings), 40).astype(int):
        stopped_at(tracks, settings, number)


@pytest.mark.slow
def test_a_stop_at_every_unit_of_the_smooth_prior_is_reported() -> None:
    tracks, settings = small(), Settings(prior="smooth")
    for number in range(1, questions(tracks, settings) + 1, 3):
        stopped_at(tracks, settings, number)


def test_progress_moves_evenly_and_never_falls() -> None:
    steps: list[Step] = []
    solve(small(), on_step=steps.append)
    fractions = np.array([step.fraction for step in steps])
    assert (np.diff(fractions) >= 0).all()
    assert fractions[-1] == 1
    assert np.diff(fractions[fractions < 0.9]).max() < 0.25
    assert {"cameras", "initialise", "reweight", "finish"} <= {step.stage for step in steps}


def test_units_fill_a_stage_and_never_overflow_it() -> None:
    steps: list[Step] = []
    monitor = Monitor(steps.append, camera_share=0.5, camera_units=10)
    for _ in range(1000):
        assert not monitor()
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert fractions[9] == pytest.approx(0.45)
    assert fractions[-1] < 0.5


def test_a_stop_is_remembered() -> None:
    answers = iter([False, True, False])
    monitor = Monitor(should_stop=lambda: next(answers))
    assert [monitor(), monitor(), monitor()] == [False, True, True]
    assert monitor.stopped


def test_a_step_that_raises_the_objective_is_rejected_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    from pliant.solver import reconstruct

    taken: list[float] = []

    def worse(problem, state, **more):  # type: ignore[no-untyped-def]
        taken.append(state.objective)
        return replace(state, shapes=state.shapes + 1, objective=2 * state.objective, reweighting=state.reweighting + 1)

    monkeypatch.setattr(reconstruct, "step", worse)
    found = solve(small(), settings=Settings(prior="smooth", refine_rotations=False))
    assert found.outcome is Outcome.REJECTED
    assert found.trace.objective[-1] == taken[0]

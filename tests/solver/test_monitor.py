"""Progress never decreases; a stop at any unit of work ends the solve as stopped, with finite shapes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from pliant.solver import Outcome, Settings, Step, Tracks, gallery, solve
from pliant.solver.monitor import Monitor
from pliant.solver.stages import Stage, settling


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
@pytest.mark.long
@pytest.mark.parametrize("noisy", [False, True])
def test_a_stop_in_every_stage_is_reported(noisy: bool) -> None:
    tracks, settings = small(noisy=noisy), Settings()
    for number in np.linspace(1, questions(tracks, settings), 8).astype(int):
        stopped_at(tracks, settings, number)


@pytest.mark.slow
@pytest.mark.long
def test_a_stop_at_every_unit_of_the_smooth_prior_is_reported() -> None:
    tracks, settings = small(), Settings(prior="smooth")
    for number in range(1, questions(tracks, settings) + 1, 11):
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
    monitor = Monitor(steps.append, plan=[Stage("scales", 2.0, 10), Stage("shapes", 2.0, 10)])
    for _ in range(1000):
        assert not monitor()
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    assert fractions[9] == pytest.approx(0.45)
    assert fractions[-1] < 0.5


def test_stages_that_do_not_run_leave_the_plan_and_others_join_it() -> None:
    steps: list[Step] = []
    plan = [Stage("multistart", 2.0, 10), Stage("scales", 100.0, 10), Stage("shapes", 2.0, 10), Stage("trust", 1.0, 10)]
    monitor = Monitor(steps.append, plan=plan)
    for _ in range(5):
        monitor()
    monitor.report(Step("cameras", 0.0))
    assert steps[-1].fraction == pytest.approx(0.45 * 2 / 105)
    monitor.enter("nothing of that name")
    monitor.enter("shapes")  # scales are left out
    monitor.report(Step("reweight", 0.5))
    assert steps[-1].fraction == pytest.approx((0.9 + 0.5 * 2) / 3.9)  # 0.9 of 2 s were done when it ended early
    monitor.expect([Stage("scales", 5.0, 10)], before="trust")
    monitor.enter("scales", units=20)  # twice as long as planned
    monitor()
    monitor.report(Step("cameras", 0.0))
    assert steps[-1].fraction == pytest.approx(1.9 / 3.9)  # a plan that grows does not go back
    monitor.enter("trust")
    assert monitor() is False
    assert steps[-1].fraction == pytest.approx((1.9 + 0.45 + 0.09) / (1.9 + 0.45 + 1))
    monitor.report(Step("finish", 1.0))
    assert steps[-1].fraction == 1.0


def test_slow_units_are_reported_however_little_they_add() -> None:
    steps: list[Step] = []
    now = [0.0]
    monitor = Monitor(steps.append, plan=[Stage("shapes", 1.0, 10**6)], clock=lambda: now[0])
    for _ in range(10):
        now[0] += 0.6
        monitor()
    assert len(steps) == 5


def test_settling_follows_the_decrease_of_the_objective() -> None:
    objectives = list(1 + 0.5 ** np.arange(20))
    shares = [settling(objectives[: count + 1], tolerance=1e-4, most=100) for count in range(15)]
    assert shares[0] == 0.0
    assert (np.diff(shares[2:]) > 0).all()
    ends = next(n for n in range(1, 20) if (objectives[n - 1] - objectives[n]) / objectives[n - 1] <= 1e-4)
    assert settling(objectives[: ends + 1], tolerance=1e-4, most=100) == 1.0
    for count in range(3, ends):
        assert shares[count] == pytest.approx(count / ends, abs=0.12)
    assert settling(objectives[:4], tolerance=1e-4, most=3) == 1.0


def test_a_stop_is_remembered() -> None:
    answers = iter([False, True, False])
    monitor = Monitor(should_stop=lambda: next(answers))
    assert [monitor(), monitor(), monitor()] == [False, True, True]
    assert monitor.stopped


def test_a_step_that_raises_the_objective_is_rejected_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    from pliant.solver.reconstruction import shapes

    taken: list[float] = []

    def worse(problem, state, **more):  # type: ignore[no-untyped-def]
        taken.append(state.objective)
        return replace(state, shapes=state.shapes + 1, objective=2 * state.objective, reweighting=state.reweighting + 1)

    monkeypatch.setattr(shapes, "step", worse)
    found = solve(small(), settings=Settings(prior="smooth", refine_rotations=False))
    assert found.outcome is Outcome.REJECTED
    assert found.trace.objective[-1] == taken[0]


def timed(plan: list[Stage]) -> tuple[Monitor, list[Step], list[float]]:
    steps: list[Step] = []
    now = [0.0]
    return Monitor(steps.append, plan=plan, clock=lambda: now[0]), steps, now


def test_a_slow_machine_multiplies_the_planned_time_that_is_left() -> None:
    monitor, steps, now = timed([Stage("multistart", 10.0, 10), Stage("scales", 5.0, 10), Stage("trust", 5.0, 10)])
    for unit in range(10):
        now[0] = 3.0 * (unit + 1)
        monitor()
    monitor.enter("scales")
    now[0] += 1.5
    monitor()
    left = steps[-1].seconds_left
    assert left is not None
    assert 0.9 * 3 * 10 < left < 1.1 * 3 * 10
    monitor.report(Step("finish", 1.0))
    assert steps[-1].seconds_left == 0.0


def test_shapes_slower_than_planned_are_extrapolated_by_themselves() -> None:
    monitor, steps, now = timed([Stage("multistart", 10.0, 10), Stage("shapes", 1.0, 100), Stage("trust", 1.0, 10)])
    for unit in range(10):
        now[0] = unit + 1.0
        monitor()
    monitor.report(Step("initialise", 0.0))
    now[0] = 20.0
    monitor()
    first = steps[-1].seconds_left
    assert first is not None
    assert 20 < first < 30, "the first reweighting alone has taken ten seconds"
    monitor.report(Step("reweight", 0.5))
    assert steps[-1].seconds_left == pytest.approx(10 + 1, rel=0.1)
    now[0] = 30.0
    monitor.enter("trust")
    monitor()
    assert steps[-1].seconds_left == pytest.approx(1, rel=0.3), "slow shapes do not slow the rest down"


def places(tracks: Tracks, settings: Settings) -> dict[str, int]:
    """The number of the first question that each place in the source asks, while nothing stops."""
    first: dict[str, int] = {}
    asked = 0

    def never() -> bool:
        nonlocal asked
        asked += 1
        caller = sys._getframe(2)  # the place that calls the monitor, which calls this
        first.setdefault(f"{Path(caller.f_code.co_filename).name}:{caller.f_lineno}", asked)
        return False

    solve(tracks, settings=settings, should_stop=never)
    return first


CASES = {
    "default": (gallery.face(3, 6, degrees=60).tracks, Settings()),
    "outliers": (small(noisy=True), Settings(order="any", camera="orthographic")),
    "perspective": (gallery.face(3, 6, degrees=60).tracks, Settings(camera="perspective", focal=900.0, prior="smooth")),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", ["default", pytest.param("outliers", marks=pytest.mark.long), "perspective"])
def test_a_stop_at_every_place_that_asks_is_reported(case: str) -> None:
    tracks, settings = CASES[case]
    asking = places(tracks, settings)
    assert len(asking) > 5, "the monitor is asked in many places"
    for number in asking.values():
        stopped_at(tracks, settings, number)


@pytest.mark.slow
def test_a_stop_at_every_single_question_of_a_small_solve_is_reported() -> None:
    tracks, settings = gallery.face(3, 6, degrees=60).tracks, Settings(prior="smooth", refine_rotations=False)
    for number in range(1, questions(tracks, settings) + 1):
        stopped_at(tracks, settings, number)

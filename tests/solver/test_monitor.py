"""Progress never decreases; a stop at any unit of work ends the solve as stopped, with finite shapes."""

from __future__ import annotations

import itertools
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from pliant.solver import KnownCamera, Outcome, Settings, Step, Tracks, gallery, solve
from pliant.solver.cameras.factorization import refine_factor
from pliant.solver.isometry import surface
from pliant.solver.model import expectation_maximisation
from pliant.solver.monitor import PACE_PRIOR, Monitor
from pliant.solver.pulse import pulse, pulses_to
from pliant.solver.stages import MOST_SHAPES_UNITS, Stage, accepted_sheet, planned, unseen_frames
from pliant.solver.threads import over_ranges, threads_limited
from pliant.solver.tracks.completion import CHUNKS_PER_TICK, POINTS_PER_CHUNK, complete
from pliant.solver.tracks.normalization import normalize
from rolled_sheets import SIZE, rolled


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


def stopped_at(tracks: Tracks, settings: Settings, number: int, cameras: KnownCamera | None = None) -> None:
    asked = 0

    def from_then_on() -> bool:
        nonlocal asked
        asked += 1
        return asked >= number

    found = solve(tracks, cameras=cameras, settings=settings, should_stop=from_then_on)
    assert found.outcome is Outcome.STOPPED, number
    assert asked == number, "a stop is not asked for twice"
    assert np.isfinite(found.shapes).all()
    assert np.isfinite(found.camera.rotations).all()


def test_a_stop_during_the_smooth_prior_is_reported() -> None:
    tracks, settings = small(), Settings(prior="smooth", refine_rotations=False, basis_size=2)
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
def test_a_stop_at_every_eleventh_query_of_the_smooth_prior_is_reported() -> None:
    tracks, settings = small(), Settings(prior="smooth")
    for number in range(1, questions(tracks, settings) + 1, 11):
        stopped_at(tracks, settings, number)


@pytest.mark.slow
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


def test_skipped_stages_leave_the_plan_and_new_ones_join_it() -> None:
    steps: list[Step] = []
    plan = [Stage("multistart", 2.0, 10), Stage("scales", 100.0, 10), Stage("shapes", 2.0, 10), Stage("trust", 1.0, 10)]
    monitor = Monitor(steps.append, plan=plan)
    for _ in range(5):
        monitor()
    monitor.report(Step("cameras", 0.0))
    assert steps[-1].fraction == pytest.approx(0.45 * 2 / 105)
    monitor.enter("nothing of that name")
    monitor.enter("shapes")  # scales are skipped
    for _ in range(5):
        monitor()
    assert steps[-1].fraction == pytest.approx((0.9 + 0.45 * 2) / 3.9)  # 0.9 of 2 s were done when it ended early
    monitor.expect([Stage("scales", 5.0, 10)], before="trust")
    monitor.enter("scales", units=20)  # twice as long as planned
    monitor()
    monitor.report(Step("cameras", 0.0))
    assert steps[-1].fraction == pytest.approx(1.8 / 3.9)  # progress does not decrease when the plan grows
    monitor.enter("trust")
    assert monitor() is False
    assert steps[-1].fraction == pytest.approx((1.8 + 0.45 + 0.09) / (1.8 + 0.45 + 1))
    monitor.report(Step("finish", 1.0))
    assert steps[-1].fraction == 1.0


def test_slow_units_are_reported_however_little_they_add() -> None:
    steps: list[Step] = []
    now = [0.0]
    monitor = Monitor(steps.append, plan=[Stage("shapes", 1.0, 10**6)], clock=lambda: now[0])
    for _ in range(10):
        now[0] += 0.3
        monitor()
    assert len(steps) == 5


def test_pulses_are_reported_after_a_silence_and_count_no_work() -> None:
    steps: list[Step] = []
    now = [0.0]
    monitor = Monitor(steps.append, plan=[Stage("shapes", 1.0, 10**6)], clock=lambda: now[0])
    pulse()  # without a receiver
    with pulses_to(monitor.pulse):
        for _ in range(10):
            now[0] += 0.3
            pulse()
    pulse()
    assert len(steps) == 5
    assert {step.fraction for step in steps} == {0.0}


@pytest.mark.parametrize("most_dense", [expectation_maximisation.MAX_DENSE_FRAMES, 0], ids=["dense", "factored"])
def test_every_round_of_em_pulses(most_dense: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expectation_maximisation, "MAX_DENSE_FRAMES", most_dense)
    made = gallery.face(9, 40, degrees=60)
    rows = (made.tracks.points - made.tracks.points.mean(axis=1, keepdims=True)).transpose(0, 2, 1).reshape(18, 40)
    gram, projections = rows @ rows.T / 40, made.rotations[:, :2]
    pulses = []
    with pulses_to(lambda: pulses.append(1)):
        expectation_maximisation.improve(
            expectation_maximisation.scratch(gram, projections, expectation_maximisation.ModelOrder()),
            gram,
            projections,
            iterations=7,
        )
    assert len(pulses) >= 7


def test_the_upgrade_of_a_factorization_pulses() -> None:
    factor = np.random.default_rng(0).normal(size=(12, 2, 6))
    pulses = []
    with pulses_to(lambda: pulses.append(1)):
        refine_factor(factor, np.eye(6, 3))
    assert len(pulses) > 5


def test_ranges_pulse_only_on_the_calling_thread() -> None:
    callers: list[int] = []
    with pulses_to(lambda: callers.append(threading.get_ident())):
        over_ranges(lambda _start, _stop: pulse(), 4)
        with threads_limited(1):
            over_ranges(lambda _start, _stop: None, 4)
    assert set(callers) == {threading.get_ident()}


@pytest.mark.parametrize("blocks", [False, True])
def test_more_frequent_reports_do_not_change_the_shapes(blocks: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = gallery.face(7, 60, degrees=60)
    settings = Settings(prior="smooth", refine_rotations=False, max_reweightings=5)
    if blocks:
        monkeypatch.setattr("pliant.solver.reconstruction.blocks.BLOCK_OBSERVATIONS", 300)
    seldom: list[Step] = []
    before = solve(sequence.tracks, sequence.mesh, settings=settings, on_step=seldom.append)
    monkeypatch.setattr("pliant.solver.monitor.MAX_SILENCE", 0.0)
    often: list[Step] = []
    after = solve(sequence.tracks, sequence.mesh, settings=settings, on_step=often.append)
    assert len(often) > 5 * len(seldom)
    assert all(one.fraction <= two.fraction for one, two in itertools.pairwise(often))
    np.testing.assert_array_equal(before.shapes, after.shapes)


def test_long_hidden_gaps_are_planned_with_more_units() -> None:
    visible = np.ones((20, 2))
    visible[3:6, 0] = visible[10:12, 0] = 0
    visible[:, 1] = [1, 0] * 10
    assert unseen_frames(visible) == 2.0  # three frames in a row, and one

    def shapes(unseen: float) -> Stage:
        plan = planned(40, 10_000, gaussian=True, known_cameras=False, sheet=False, unseen=unseen)
        return next(stage for stage in plan if stage.name == "shapes")

    assert shapes(0).units < shapes(2).units < shapes(20).units < shapes(1000).units == MOST_SHAPES_UNITS
    assert shapes(20).seconds > 4 * shapes(0).seconds


def test_a_lower_tolerance_is_planned_with_more_units() -> None:
    def shapes(tolerance: float) -> Stage:
        plan = planned(40, 800, gaussian=False, known_cameras=True, sheet=False, tolerance=tolerance)
        return next(stage for stage in plan if stage.name == "shapes")

    assert [shapes(tolerance).units for tolerance in (1e-2, 1e-4, 1e-8)] == [28, 55, 110]
    assert shapes(1e-8).seconds == pytest.approx(2 * shapes(1e-4).seconds)
    assert shapes(0.999).units == 1


@pytest.mark.parametrize("frames", [20, 30])
def test_choosing_anchors_in_all_frames_is_a_stage_of_its_own(frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = planned(frames, 60, gaussian=True, known_cameras=False, sheet=True)
    monitor, seen = Monitor(plan=plan), list[tuple[str, int]]()

    def prepared(points: np.ndarray, confidence: np.ndarray, centre: np.ndarray, should_stop: object) -> object:
        seen.append((monitor.current.name, len(points)))
        return object()

    monkeypatch.setattr(surface, "_prepared", prepared)
    monkeypatch.setattr(surface, "_implausible", lambda search, focal, required: None)
    surface._search(gallery.flag(frames, 60).tracks, np.zeros(2), 500.0, False, monitor)
    assert seen == ([("surface", 20)] if frames == 20 else [("first_look", 24), ("anchors", 30)])
    assert monitor.current.name == "surface"
    times = {
        stage.name: stage.seconds for stage in planned(10 * frames, 60, gaussian=True, known_cameras=False, sheet=True)
    }
    assert times["anchors"] == pytest.approx(0.1 * frames)


def test_an_accepted_sheet_replaces_the_plan_unless_it_turns_out_to_be_rigid() -> None:
    clock = Clock(Stage("surface", 10.0, 10), Stage("multistart", 100.0, 10), Stage("shapes", 50.0, 10))
    clock.work(10, 1.0)
    pace = (PACE_PRIOR + 10) / (PACE_PRIOR + 9)  # 10 s for .9 of the stage
    assert clock.left == pytest.approx(1 + 150 * pace, rel=0.01)
    clock.monitor.expect_only([Stage("sheet", 5.0, 10), Stage("sheet_points", 1.0, 1)])
    clock.monitor.expect_only([Stage("sheet", 5.0, 10), Stage("sheet_points", 1.0, 1)])  # as without a choice
    clock.monitor.enter("sheet")
    assert clock.left == pytest.approx(6 * pace, rel=0.01)
    clock.monitor.enter("multistart")
    assert clock.left == pytest.approx(150 * pace, rel=0.01)
    clock.monitor.enter("sheet")  # no longer planned
    assert clock.monitor.current.name == "multistart"


@pytest.mark.parametrize("frames", [12, 30])
def test_an_accepted_sheet_goes_through_its_planned_stages(frames: int) -> None:
    tracks = rolled(frames=frames, side=6).tracks
    plan = planned(frames, tracks.num_points, gaussian=True, known_cameras=False, sheet=True)
    monitor, entered = Monitor(plan=plan), list[str]()
    enter = monitor.enter

    def noted(name: str, *, units: int | None = None) -> None:
        enter(name, units=units)
        entered.append(monitor.current.name)

    monitor.enter = noted  # type: ignore[method-assign]
    verdict = surface.isometric_surface(tracks, image_size=SIZE, should_stop=monitor)
    assert verdict.surface is not None
    sheet = [stage.name for stage in accepted_sheet(frames, tracks.num_points)]
    assert entered[-len(sheet) :] == sheet
    assert sheet == ["sheet", *(["sheet_frames"] if frames > 24 else []), "sheet_points", "sheet_error"]
    monitor.report(Step("cameras", 0.0))
    assert monitor._seconds_left() < 1


class Clock:
    """A monitor of a plan whose units take given times."""

    def __init__(self, *plan: Stage) -> None:
        self.now = 0.0
        self.steps: list[Step] = []
        self.monitor = Monitor(self.steps.append, plan=plan, clock=lambda: self.now)

    def work(self, units: int, seconds: float) -> None:
        for _ in range(units):
            self.now += seconds
            self.monitor()

    @property
    def left(self) -> float:
        self.monitor.report(Step("cameras", 0.0))
        left = self.steps[-1].seconds_left
        assert left is not None
        return left


def test_the_pace_of_finished_stages_predicts_later_ones() -> None:
    clock = Clock(Stage("starts", 8.0, 80), Stage("scales", 10.0, 10), Stage("shapes", 20.0, 100))
    assert clock.left == pytest.approx(38)
    clock.work(80, 0.2)  # twice as long as planned
    clock.monitor.enter("scales")
    assert clock.left == pytest.approx(30 * (16 + PACE_PRIOR) / (0.9 * 8 + PACE_PRIOR))


def test_a_stage_that_ends_early_does_not_change_the_pace() -> None:
    clock = Clock(Stage("refinement", 10.0, 1000), Stage("starts", 5.0, 100), Stage("scales", 2.0, 100))
    clock.work(100, 0.009)  # .09 of the stage
    clock.monitor.enter("scales")  # starts are skipped
    assert clock.left == pytest.approx(2)


@pytest.mark.parametrize("pace", [0.1, 1.0, 10.0])
def test_the_pace_of_the_current_stage_replaces_that_of_the_plan(pace: float) -> None:
    clock = Clock(Stage("shapes", 10.0, 100))
    left = []
    for _ in range(10):
        clock.work(10, pace * 0.1)
        left.append(clock.left)
    ratio = np.array(left[:9]) / (pace * np.arange(9, 0, -1))
    assert (ratio[2:] > 0.5).all()
    assert (ratio[2:8] < 2).all()  # the last tenth of the share is for further units


def test_corrections_for_perspective_are_a_stage_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []
    enter = Monitor.enter

    def noted(monitor: Monitor, name: str, *, units: int | None = None) -> None:
        enter(monitor, name, units=units)
        if monitor.current.name not in begun:
            begun.append(monitor.current.name)

    monkeypatch.setattr(Monitor, "enter", noted)
    face = gallery.face(8, 60, degrees=70)
    known = KnownCamera.from_arrays(face.rotations)
    steps: list[Step] = []
    solve(face.tracks, cameras=known, settings=Settings(focal=2000.0, image_size=(640, 480)), on_step=steps.append)
    assert begun[-4:] == ["shapes", "corrections", "finish", "trust"]
    fractions = [step.fraction for step in steps]
    assert fractions == sorted(fractions)
    begun.clear()
    solve(face.tracks, cameras=known, settings=Settings(camera="orthographic"))
    assert begun[-3:] == ["shapes", "finish", "trust"]


def test_progress_accounts_for_growing_unit_times_and_setup() -> None:
    def filled(stage: Stage, units: int) -> float:
        steps: list[Step] = []
        monitor = Monitor(steps.append, plan=[stage])
        for _ in range(units):
            monitor()
        monitor.report(Step("cameras", 0.0))
        return steps[-1].fraction

    assert filled(Stage("completion", 1.0, 6, growth=2.0), 5) == pytest.approx(31 / 127)
    assert filled(Stage("surface", 1.0, 60, setup=40), 20) == pytest.approx(0.9 * 0.6)


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


def test_remaining_time_scales_with_the_measured_pace() -> None:
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


def test_a_stage_that_takes_longer_than_planned_is_extrapolated_from_its_units() -> None:
    monitor, steps, now = timed([Stage("multistart", 10.0, 10), Stage("shapes", 1.0, 100), Stage("trust", 1.0, 10)])
    for unit in range(10):
        now[0] = unit + 1.0
        monitor()
    monitor.enter("shapes")
    for _ in range(20):
        now[0] += 2
        monitor()
    left = steps[-1].seconds_left
    assert left is not None
    assert 120 < left < 200, "80 units of 2 s"


def places(tracks: Tracks, settings: Settings, cameras: KnownCamera | None = None) -> dict[str, int]:
    """The index of the first stop query from each source location, in a solve that is not stopped."""
    first: dict[str, int] = {}
    asked = 0

    def never() -> bool:
        nonlocal asked
        asked += 1
        caller = sys._getframe(2)  # the caller of the monitor, which calls this
        first.setdefault(f"{Path(caller.f_code.co_filename).name}:{caller.f_lineno}", asked)
        return False

    solve(tracks, cameras=cameras, settings=settings, should_stop=never)
    return first


CASES = {
    "default": (gallery.face(3, 6, degrees=60).tracks, Settings()),
    "outliers": (small(noisy=True), Settings(order="any", camera="orthographic")),
    "perspective": (gallery.face(3, 6, degrees=60).tracks, Settings(camera="perspective", focal=900.0, prior="smooth")),
}


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_a_stop_at_every_call_site_is_reported(case: str) -> None:
    tracks, settings = CASES[case]
    cameras = KnownCamera.from_arrays(np.tile(np.eye(3), (tracks.num_frames, 1, 1)))
    asking, later = places(tracks, settings), places(tracks, settings, cameras)
    assert len(asking) > 5, "the monitor is asked in many places"
    for number in later.values():  # known cameras reach these sooner
        stopped_at(tracks, settings, number, cameras)
    for place in asking.keys() - later.keys():
        stopped_at(tracks, settings, asking[place])


@pytest.mark.slow
def test_a_stop_at_every_third_query_of_a_small_solve_is_reported() -> None:
    tracks, settings = (
        gallery.face(3, 6, degrees=60).tracks,
        Settings(prior="smooth", refine_rotations=False, max_reweightings=2, basis_size=1),
    )
    for number in range(1, questions(tracks, settings) + 1, 3):
        stopped_at(tracks, settings, number)


def test_the_plan_counts_the_gram_matrix_of_many_points() -> None:
    few, many = (
        planned(100, points, gaussian=True, known_cameras=False, sheet=False)[0] for points in (1_000, 1_000_000)
    )
    assert few.name == many.name == "completion"
    assert few.seconds < 0.2
    assert 5 < many.seconds < 20  # 100 × 1,000,000 took 15 s with the normalization


def test_the_completion_of_clean_tracks_is_planned_with_as_many_units_as_it_takes() -> None:
    asked: list[int] = []
    complete(normalize(gallery.talk(40, 200).tracks), should_stop=lambda: bool(asked.append(1)))
    clean, hidden = (
        planned(20, 100, gaussian=False, known_cameras=False, sheet=False, unseen=unseen)[0] for unseen in (0.0, 1.0)
    )
    assert clean.name == hidden.name == "completion"
    assert clean.units == len(asked) < hidden.units


def test_the_gram_matrix_of_many_points_polls_for_a_stop() -> None:
    points = np.random.default_rng(0).standard_normal((3, 2 * CHUNKS_PER_TICK * POINTS_PER_CHUNK, 2))
    asked = []
    complete(normalize(Tracks.from_arrays(points)), seed=0, should_stop=lambda: bool(asked.append(1)))
    few = []
    complete(normalize(Tracks.from_arrays(points[:, :1000])), seed=0, should_stop=lambda: bool(few.append(1)))
    assert len(asked) >= len(few) + 2


def test_the_plan_of_a_long_film_has_fewer_learned_frames_and_an_extension() -> None:
    film, photographs = (
        {
            stage.name: stage.seconds
            for stage in planned(300, 100, gaussian=True, known_cameras=False, sheet=False, ordered=ordered)
        }
        for ordered in (True, False)
    )
    assert film.keys() - photographs.keys() == {"extension"}
    assert film["refinement"] < 0.6 * photographs["refinement"]


def test_the_plan_counts_the_factorization_of_all_frames_without_a_learned_prior() -> None:
    short, long = (
        {stage.name: stage.seconds for stage in planned(frames, 300, gaussian=False, known_cameras=False, sheet=False)}
        for frames in (300, 3000)
    )
    assert long["factorization"] == pytest.approx(100 * short["factorization"])
    assert long["factorization"] > 10
    assert long["completion"] > 2  # with the Gram matrix

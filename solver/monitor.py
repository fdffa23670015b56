"""Progress and cancellation of a solve: every call of `should_stop` also counts one unit of work."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from pliant.solver.descent import Descent
from pliant.solver.records import Step
from pliant.solver.stages import Load, Pace, Stage

MIN_FRACTION_STEP = 0.002
"""Minimum increase of the fraction between reports: at most 500 calls of `on_step` besides those due to stages and `MAX_SILENCE`."""

MAX_SILENCE = 0.5
"""Seconds without a report after which the next unit of work or pulse is reported regardless of the fraction."""

EXPECTED_SHARE = 0.9
"""Completed share of a stage after its expected units; further units approach 1."""

MAX_FRACTION = 0.99
"""Largest fraction reported before the end."""


class Monitor:
    """Report steps with a fraction that never decreases, and remember a request to stop.

    A call counts one unit of work and returns whether to stop; pass the monitor on as `should_stop`. Once a call has returned True, all
    later ones do. The fraction is the expected duration of the finished stages divided by that of all stages, so elapsed time divided by it
    estimates the total. Stages that do not run are dropped from the plan.

    Parameters
    ----------
    on_step : callable, optional
        The user's; called with the progress.
    should_stop : callable, optional
        The user's; returns True to stop the solve.
    plan : sequence of Stage
        Expected stages of the solve, in order.
    descent : Descent, optional
        Prediction of the reweightings.
    seconds_per_iteration : float
        Planned time of a conjugate-gradient iteration.
    clock : callable
        Monotonic seconds.
    work : callable
        Processor seconds of this process. They measure the pace, so that other load on the machine does not count as slow work; the
        remaining time is converted to wall time by the latest seconds per processor second.
    """

    def __init__(
        self,
        on_step: Callable[[Step], None] | None = None,
        should_stop: Callable[[], bool] | None = None,
        *,
        plan: Sequence[Stage] = (Stage("shapes", 1.0, 1000),),
        descent: Descent | None = None,
        seconds_per_iteration: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
        work: Callable[[], float] = time.process_time,
    ) -> None:
        self.stopped = False
        """Whether a unit of work found a request to stop."""
        self._on_step, self._should_stop, self._clock, self._work = on_step, should_stop, clock, work
        self._last = Step("cameras", 0.0)
        self._reported = clock()
        self._done, self._current, self._ahead = 0.0, plan[0], list(plan[1:])
        self._units, self._share, self._blocks = 0, 0.0, False
        self._pace, self._load = Pace(work()), Load(clock(), work())
        self._descent = Descent() if descent is None else descent
        self._seconds_per_iteration = seconds_per_iteration

    def __call__(self) -> bool:
        """Count a unit of work; return whether to stop."""
        if not self.stopped and self._should_stop is not None:
            self.stopped = bool(self._should_stop())
        self._units += 1
        if self._current.name == "shapes":
            self._descent.current += 1
        else:
            self._share = max(self._share, _filled(self._units, self._current))
        fraction = self._fraction()
        if fraction >= self._last.fraction + MIN_FRACTION_STEP or self._clock() - self._reported >= MAX_SILENCE:
            self._emit(replace(self._last, fraction=fraction))
        return self.stopped

    def pulse(self) -> None:
        """Report the progress again after `MAX_SILENCE`; counts no unit of work."""
        if self._clock() - self._reported >= MAX_SILENCE:
            self._emit(replace(self._last, fraction=self._fraction()))

    def enter(self, name: str, *, units: int | None = None) -> None:
        """Begin a stage and drop the planned stages before it; do nothing if the stage is not ahead.

        Parameters
        ----------
        name : str
            Name of the stage.
        units : int, optional
            Expected units of work, replacing the planned number.
        """
        place = next((number for number, stage in enumerate(self._ahead) if stage.name == name), None)
        if place is None:
            return
        self._done += self._share * self._current.seconds  # less than planned if it ended early
        self._pace.next(self._current, self._share, self._work())
        self._current, self._ahead = self._ahead[place], self._ahead[place + 1 :]
        if units is not None:
            seconds = self._current.seconds * units / max(self._current.units, 1)
            self._current = replace(self._current, seconds=seconds, units=units)
        self._units, self._share = 0, 0.0
        if name == "shapes":
            self._descent.begin(None, self._work())

    def expect(self, stages: Sequence[Stage], *, before: str) -> None:
        """Insert stages that the data require into the plan, before the stage named `before`, or at the end without it."""
        place = next((number for number, stage in enumerate(self._ahead) if stage.name == before), len(self._ahead))
        self._ahead[place:place] = stages

    def expect_corrections(self, ahead: int) -> None:
        """Expect at most `ahead` corrections of the tracks for perspective; call before the first and after each."""
        self._descent.expect_corrections(ahead)

    def report(self, step: Step) -> None:
        """Report a step; the objectives of initialisation and reweightings determine the completed share of the stage `shapes`."""
        if step.stage == "finish":
            self._emit(replace(step, fraction=step.fraction if step.fraction == 1 else self._fraction()))
            return
        if step.stage == "initialise":
            self.enter("shapes")
            self._descent.begin(step.objective, self._work())
        elif step.stage == "reweight" and step.objective is not None:
            self._descent.reweighted(step.objective)
            self._share = max(self._share, self._descent.share())
        self._emit(replace(step, fraction=self._fraction()))

    def report_block(self, step: Step, share: float) -> None:
        """Report a step of one of several blocks of points; `share` is the completed share of the stage `shapes`."""
        self.enter("shapes")
        self._blocks, self._share = True, max(self._share, share)
        self._emit(replace(step, fraction=self._fraction()))

    def _fraction(self) -> float:
        done = self._done + self._share * self._current.seconds
        left = (1 - self._share) * self._current.seconds + sum(stage.seconds for stage in self._ahead)
        return max(self._last.fraction, min(done / max(done + left, 1e-9), MAX_FRACTION))

    def _left(self) -> float:
        ahead, now = sum(stage.seconds for stage in self._ahead), self._work()
        if self._current.name != "shapes" or self._blocks:
            left = self._pace.left(self._current, self._share, ahead, now)
        else:
            per_iteration = self._pace.known * self._seconds_per_iteration
            left = self._descent.seconds_left(now, seconds_per_iteration=per_iteration) + self._pace.known * ahead
        return left * self._load.seconds_per_work(self._clock(), now)

    def _emit(self, step: Step) -> None:
        left = 0.0 if step.fraction == 1 else self._left()
        self._last, self._reported = replace(step, seconds_left=left), self._clock()
        if self._on_step is not None:
            self._on_step(self._last)


def enter(should_stop: Callable[[], bool] | None, name: str, *, units: int | None = None) -> None:
    """Begin a stage if `should_stop` is a `Monitor`; otherwise do nothing."""
    if isinstance(should_stop, Monitor):
        should_stop.enter(name, units=units)


def _filled(units: int, stage: Stage) -> float:
    """Return the completed share of a stage after `units` units of work: increasing and below 1."""
    share = (units + stage.setup) / max(stage.units + stage.setup, 1)
    if share > 1:
        return 1 - (1 - EXPECTED_SHARE) / share
    if stage.growth == 1:
        return EXPECTED_SHARE * share
    return float((stage.growth**units - 1) / (stage.growth ** (stage.units + 1) - 1))

"""Progress and cancellation of a solve: every call of `should_stop` also counts one unit of work."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from pliant.solver.records import Step
from pliant.solver.stages import Stage

MIN_FRACTION_STEP = 0.002
"""Minimum increase of the fraction between reports: at most 500 calls of `on_step` besides those due to stages and `MAX_SILENCE`."""

MAX_SILENCE = 0.5
"""Seconds without a report after which the next unit of work or pulse is reported regardless of the fraction."""

EXPECTED_SHARE = 0.9
"""Completed share of a stage after its expected units; further units approach 1."""

MAX_FRACTION = 0.99
"""Largest fraction reported before the end."""

PACE_PRIOR = 0.5
"""Planned seconds that count as measured at the planned pace, so that the first units alone do not determine the pace."""

OWN_PACE = 4.0
"""Weight of a stage's own pace, per completed share of it, at most 1, relative to the pace of all stages: its units take similar times."""


class Monitor:
    """Report steps with a fraction that never decreases and the remaining time, and remember a request to stop.

    A call counts one unit of work and returns whether to stop; pass the monitor on as `should_stop`. Once a call has returned True, all
    later ones do. Stages that do not run are dropped from the plan.

    The fraction is the planned duration of the finished work divided by that of all stages. The pace, the measured duration of the finished
    work divided by its planned one, adapts the remaining time to speed and load of the machine. As the current stage advances, its own pace
    replaces that of all stages, because its units take similar times.

    Parameters
    ----------
    on_step : callable, optional
        The user's; called with the progress.
    should_stop : callable, optional
        The user's; returns True to stop the solve.
    plan : sequence of Stage
        Expected stages of the solve, in order.
    clock : callable
        Monotonic seconds.
    """

    def __init__(
        self,
        on_step: Callable[[Step], None] | None = None,
        should_stop: Callable[[], bool] | None = None,
        *,
        plan: Sequence[Stage] = (Stage("shapes", 1.0, 1000),),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stopped = False
        """Whether a unit of work found a request to stop."""
        self.current = plan[0]
        """The current stage."""
        self._on_step, self._should_stop, self._clock = on_step, should_stop, clock
        self._last = Step("cameras", 0.0)
        self._ahead = list(plan[1:])
        self._unlikely: list[Stage] = []
        self._began = self._reported = clock()
        self._units, self._share = 0, 0.0  # of the current stage
        self._done = 0.0  # planned seconds of all work before it
        self._measured = self._planned = PACE_PRIOR  # seconds of the finished stages

    def __call__(self) -> bool:
        """Count a unit of work; return whether to stop."""
        if not self.stopped and self._should_stop is not None:
            self.stopped = bool(self._should_stop())
        self._units += 1
        self._share = max(self._share, _filled(self._units, self.current))
        if self._fraction() >= self._last.fraction + MIN_FRACTION_STEP:
            self.report(self._last)
        else:
            self.pulse()
        return self.stopped

    def pulse(self) -> None:
        """Report the progress again after `MAX_SILENCE`; counts no unit of work."""
        if self._clock() - self._reported >= MAX_SILENCE:
            self.report(self._last)

    def enter(self, name: str, *, units: int | None = None) -> None:
        """Begin a stage and drop the planned stages before it; do nothing if the stage is not ahead.

        Parameters
        ----------
        name : str
            Name of the stage.
        units : int, optional
            Expected units of work, replacing the planned number.
        """
        place = self._place(name)
        if place is None and any(stage.name == name for stage in self._unlikely):
            self._ahead, self._unlikely = self._unlikely, []
            place = self._place(name)
        if place is None:
            return
        done, now = self._share * self.current.seconds, self._clock()  # less than planned if it ended early
        if done > 0:
            self._measured, self._planned = self._measured + now - self._began, self._planned + done
        self._done, self._began = self._done + done, now
        self.current, self._ahead = self._ahead[place], self._ahead[place + 1 :]
        if units is not None:
            seconds = self.current.seconds * units / max(self.current.units, 1)
            self.current = replace(self.current, seconds=seconds, units=units)
        self._units, self._share = 0, 0.0

    def expect(self, stages: Sequence[Stage], *, before: str) -> None:
        """Insert stages that the data require into the plan, before the stage named `before`, or at the end without it."""
        place = self._place(before)
        place = len(self._ahead) if place is None else place
        self._ahead[place:place] = stages

    def expect_only(self, stages: Sequence[Stage]) -> None:
        """Replace the stages ahead, which probably do not run, until one of them begins."""
        self._ahead, self._unlikely = list(stages), [*self._ahead, *self._unlikely]

    def report(self, step: Step) -> None:
        """Report a step with the present fraction and remaining time; a fraction of 1 is kept."""
        ended = step.fraction == 1
        fraction, left = (1.0, 0.0) if ended else (self._fraction(), self._seconds_left())
        self._last, self._reported = replace(step, fraction=fraction, seconds_left=left), self._clock()
        if self._on_step is not None:
            self._on_step(self._last)

    def report_block(self, step: Step, share: float) -> None:
        """Report a step of one of several blocks of points; `share` is the completed share of the stage `shapes`."""
        self.enter("shapes")
        self._share = max(self._share, share)
        self.report(step)

    def _place(self, name: str) -> int | None:
        return next((place for place, stage in enumerate(self._ahead) if stage.name == name), None)

    def _fraction(self) -> float:
        done = self._done + self._share * self.current.seconds
        left = (1 - self._share) * self.current.seconds + sum(stage.seconds for stage in self._ahead)
        return max(self._last.fraction, min(done / max(done + left, 1e-9), MAX_FRACTION))

    def _seconds_left(self) -> float:
        share, planned, spent = self._share, self.current.seconds, self._clock() - self._began
        ahead = sum(stage.seconds for stage in self._ahead)
        if share <= 0:
            pace = self._measured / self._planned
            return max(pace * planned - spent, 0.0) + pace * ahead
        pace = (self._measured + spent) / (self._planned + share * planned)
        own = min(OWN_PACE * share, 1.0)
        return (1 - share) * ((1 - own) * pace * planned + own * spent / share) + pace * ahead


def enter(should_stop: Callable[[], bool] | None, name: str, *, units: int | None = None) -> None:
    """Begin a stage if `should_stop` is a `Monitor`; otherwise do nothing."""
    if isinstance(should_stop, Monitor):
        should_stop.enter(name, units=units)


def expect_only(should_stop: Callable[[], bool] | None, stages: Sequence[Stage]) -> None:
    """Plan only these stages ahead if `should_stop` is a `Monitor`; otherwise do nothing."""
    if isinstance(should_stop, Monitor):
        should_stop.expect_only(stages)


def _filled(units: int, stage: Stage) -> float:
    """Return the completed share of a stage after `units` units of work: increasing and below 1."""
    share = (units + stage.setup) / max(stage.units + stage.setup, 1)
    if share > 1:
        return 1 - (1 - EXPECTED_SHARE) / share
    if stage.growth == 1:
        return EXPECTED_SHARE * share
    return float((stage.growth**units - 1) / (stage.growth ** (stage.units + 1) - 1))

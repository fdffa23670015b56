"""Progress and cancellation of one solve: each call of `should_stop` also counts one unit of work."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pliant.solver.records import Step

MIN_FRACTION_STEP = 0.002
"""Minimum increase of the fraction between reports: at most 500 calls of `on_step` besides those of the stages."""

REWEIGHTING_UNITS = 100
"""Typical number of conjugate gradient iterations per reweighting; 20 to 300 occur."""

EXPECTED_SHARE = 0.9
"""Share of a stage's span that its expected units fill; further units approach its end."""


class Monitor:
    """Reports steps with a fraction that never decreases, and remembers a request to stop.

    A call counts one unit of work and returns whether to stop; pass the monitor on as `should_stop`. Once it has
    returned True it always does.

    Parameters
    ----------
    on_step, should_stop : callable, optional
        The callbacks given to `solve`.
    camera_share : float
        Estimated share of the solve spent on the cameras. Fractions of steps of stage `cameras` refer to the whole solve,
        those of later steps to the remainder.
    camera_units : int
        Estimated units of work of the cameras.
    """

    def __init__(
        self,
        on_step: Callable[[Step], None] | None = None,
        should_stop: Callable[[], bool] | None = None,
        *,
        camera_share: float = 0.3,
        camera_units: int = 1000,
    ) -> None:
        self.stopped = False
        """Whether a stop was requested at the last call."""
        self._on_step, self._should_stop = on_step, should_stop
        self._share = camera_share
        self._last = Step("cameras", 0.0)
        self._begun, self._span, self._expected, self._units = 0.0, camera_share, camera_units, 0

    def __call__(self) -> bool:
        """Count a unit of work; return whether to stop."""
        if not self.stopped and self._should_stop is not None:
            self.stopped = bool(self._should_stop())
        self._units += 1
        fraction = self._begun + self._span * _filled(self._units / self._expected)
        if fraction >= self._last.fraction + MIN_FRACTION_STEP:
            self._emit(replace(self._last, fraction=fraction))
        return self.stopped

    def report(self, step: Step) -> None:
        """Report a step; its fraction never falls below that of the previous step."""
        share = self._share
        fraction = step.fraction if step.stage == "cameras" else share + (1 - share) * step.fraction
        self._emit(replace(step, fraction=max(fraction, self._last.fraction)))
        if step.stage != "cameras":
            self._begun, self._expected, self._units = self._last.fraction, REWEIGHTING_UNITS, 0
            self._span = (1 - self._begun) / (2 + max(step.max_reweightings - step.reweighting, 0))

    def _emit(self, step: Step) -> None:
        self._last = step
        if self._on_step is not None:
            self._on_step(step)


def _filled(share: float) -> float:
    """Return the completed part of a stage after this share of its expected units: increasing and below 1."""
    return EXPECTED_SHARE * share if share <= 1 else 1 - (1 - EXPECTED_SHARE) / share

"""Progress and cancellation of one solve, in one object: every question whether to stop is also a unit of work done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pliant.solver.records import Step

FINEST = 0.002
"""Least growth of the fraction that is reported on its own: at most 500 calls of `on_step` beside those of the stages."""

REWEIGHTING_UNITS = 100
"""Conjugate-gradient iterations of one reweighting, about: 20 to 300."""

NEARLY = 0.9
"""Share of a stage's span that its expected units fill; further units approach its end."""


class Monitor:
    """Reports steps whose fraction never falls, and remembers a request to stop.

    Calling it counts one unit of work and returns whether to stop: it is handed down as `should_stop`. Once that was True it stays True.

    Parameters
    ----------
    on_step, should_stop : callable, optional
        The user's.
    camera_share : float
        Share of the whole that the cameras take. Fractions of steps of stage `cameras` are of the whole, those of later steps of what is
        left after the cameras.
    camera_units : int
        Units of work that the cameras take, about.
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
        """Whether a stop was requested when somebody looked."""
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
        if fraction >= self._last.fraction + FINEST:
            self._report(replace(self._last, fraction=fraction))
        return self.stopped

    def tell(self, step: Step) -> None:
        """Report a step, its fraction raised to that of the step before if it is lower."""
        share = self._share
        fraction = step.fraction if step.stage == "cameras" else share + (1 - share) * step.fraction
        self._report(replace(step, fraction=max(fraction, self._last.fraction)))
        if step.stage != "cameras":
            self._begun, self._expected, self._units = self._last.fraction, REWEIGHTING_UNITS, 0
            self._span = (1 - self._begun) / (2 + max(step.max_reweightings - step.reweighting, 0))

    def _report(self, step: Step) -> None:
        self._last = step
        if self._on_step is not None:
            self._on_step(step)


def _filled(share: float) -> float:
    """Return the part of a stage done after this share of its expected units: it rises for ever and stays below 1."""
    return NEARLY * share if share <= 1 else 1 - (1 - NEARLY) / share

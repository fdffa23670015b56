"""Progress of a job: one fraction from the steps of its parts, with an estimate of the remaining time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

from pliant.schemas.job import FollowedPoints, Progress

SHARES = {"loading": (0.0, 0.02), "solving": (0.02, 0.85), "exporting": (0.85, 1.0)}
"""Start and end of each part of a job as fractions of the whole."""

FILM_SHARES = {"track": (0.0, 0.5), "loading": (0.5, 0.51), "solving": (0.51, 0.93), "exporting": (0.93, 1.0)}
"""The same for a film, from the timings of films of a few seconds on two cores."""

WORTH_ESTIMATING = 0.05
"""Fraction from which the remaining time is extrapolated from the elapsed time."""


@dataclass(slots=True)
class Reporter:
    """Combines the progress of parts into one fraction that never decreases.

    Parameters
    ----------
    on_progress : callable
        Called with every `Progress`.
    clock : callable
        Monotonic seconds.
    shares : mapping
        The parts of the job.
    """

    on_progress: Callable[[Progress], None]
    clock: Callable[[], float] = time.monotonic
    shares: Mapping[str, tuple[float, float]] = field(default_factory=lambda: SHARES)
    _began: float | None = None
    _furthest: float = 0.0
    _last: dict[str, int | float | None] = field(default_factory=dict)

    def part(
        self,
        part: str,
        done: float,
        *,
        stage: str | None = None,
        reweighting: int | None = None,
        max_reweightings: int | None = None,
        objective: float | None = None,
        residual: float | None = None,
        followed: FollowedPoints | None = None,
    ) -> None:
        """Report that the share `done` (0 to 1) of a part is done; omitted numbers keep their last value.

        Parameters
        ----------
        part : str
            A key of `shares`.
        stage : str, optional
            Stage to report; the name of the part by default.
        followed : FollowedPoints, optional
            Points of the film that were just tracked; not repeated later.
        """
        now = self.clock()
        if self._began is None:
            self._began = now
        given = {
            "reweighting": reweighting, "max_reweightings": max_reweightings, "objective": objective, "residual": residual,
        }  # fmt: skip
        self._last |= {name: value for name, value in given.items() if value is not None}
        low, high = self.shares[part]
        self._furthest = max(self._furthest, low + (high - low) * min(max(done, 0.0), 1.0))
        fraction, spent = self._furthest, now - self._began
        left = spent * (1 - fraction) / fraction if fraction >= WORTH_ESTIMATING else None
        self.on_progress(
            Progress.model_validate(
                {
                    **self._last,
                    "stage": stage or part,
                    "followed": followed,
                    "fraction": fraction,
                    "seconds_left": None if left is None else round(left, 1),
                    "updated_at": datetime.now(UTC),
                }
            )
        )

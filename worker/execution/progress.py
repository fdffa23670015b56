"""Progress of a job: one fraction over all its parts, and an estimate of the remaining time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from pliant.schemas.job import FollowedPoints, Progress

SHARES = {"loading": (0.0, 0.02), "solving": (0.02, 0.85), "exporting": (0.85, 1.0)}
"""Start and end of each part as fractions of the job, used while no time estimate is available."""

FILM_SHARES = {"track": (0.0, 0.5), "loading": (0.5, 0.51), "solving": (0.51, 0.93), "exporting": (0.93, 1.0)}
"""The same for a film, from the timings of films of a few seconds on two cores."""

WORTH_ESTIMATING = 0.05
"""Minimum fraction for extrapolating the remaining time from the elapsed time."""

TICK = 1.0
"""Seconds without a report after which the last progress is repeated, with an updated remaining time."""


@dataclass(slots=True)
class Reporter:
    """Combines the progress of parts into one fraction that never decreases.

    If a part reports its remaining seconds, the fraction is the elapsed time divided by the expected total. Otherwise the fraction
    follows from `shares`, and the remaining time is extrapolated from the elapsed time.

    Parameters
    ----------
    on_progress : callable
        Called with every `Progress`, by one thread at a time.
    clock : callable
        Monotonic seconds.
    shares : mapping
        Start and end of each part, as fractions of the job.
    """

    on_progress: Callable[[Progress], None]
    clock: Callable[[], float] = time.monotonic
    shares: Mapping[str, tuple[float, float]] = field(default_factory=lambda: SHARES)
    export_seconds: float = 0.0
    """Expected seconds of the part `exporting`."""
    following_seconds: float = 0.0
    """Expected seconds of everything after the part `track`; 0 if unknown."""
    _began: float | None = None
    _export_began: float | None = None
    _furthest: float = 0.0
    _sent: float = 0.0
    _left: tuple[float, float] | None = None
    """Remaining seconds, and the clock time of this estimate."""
    _last: dict[str, Any] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

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
        seconds_left: float | None = None,
        followed: FollowedPoints | None = None,
    ) -> None:
        """Report the completed share `done` (0 to 1) of a part, a key of `shares`; omitted solver numbers keep their last value.

        `stage` defaults to the part. `seconds_left` is the time until this part ends. `followed`, the points just tracked, is
        sent only once.
        """
        with self._lock:
            now = self.clock()
            if self._began is None:
                self._began = now
            given = {
                "reweighting": reweighting, "max_reweightings": max_reweightings, "objective": objective, "residual": residual,
            }  # fmt: skip
            self._last |= {name: value for name, value in given.items() if value is not None}
            self._last["stage"] = stage or part
            done = min(max(done, 0.0), 1.0)
            low, high = self.shares[part]
            spent = now - self._began
            left = self._known_left(part, done, seconds_left, now)
            if left is None:
                self._furthest = max(self._furthest, low + (high - low) * done)
                # Until a film's points are placed, nothing is known about the time of the solve.
                if self._furthest >= WORTH_ESTIMATING and part != "track":
                    left = spent * (1 - self._furthest) / self._furthest
            else:
                self._furthest = max(self._furthest, spent / (spent + left) if spent + left > 0 else 1.0)
            self._left = None if left is None else (left, now)
            self._send(now, left, followed)

    @contextmanager
    def ticking(self) -> Iterator[None]:
        """Repeat the last progress from a separate thread whenever nothing was reported for `TICK` seconds."""
        ended = threading.Event()

        def repeat() -> None:
            while not ended.wait(TICK / 2):
                self.tick()

        thread = threading.Thread(target=repeat, name="pliant-ticks", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def tick(self) -> None:
        """Repeat the last progress, with an updated remaining time, if nothing was reported for `TICK` seconds."""
        with self._lock:
            now = self.clock()
            if self._began is None or now - self._sent < TICK:
                return
            left = None if self._left is None else max(0.0, self._left[0] - (now - self._left[1]))
            self._send(now, left, None)

    def _known_left(self, part: str, done: float, seconds_left: float | None, now: float) -> float | None:
        if part == "exporting" and done == 1.0:
            return 0.0
        if part == "exporting" and self.export_seconds > 0:
            if self._export_began is None:
                self._export_began = now
            # The weight shifts from the planned to the elapsed time as the export proceeds.
            return (1 - done) * ((1 - done) * self.export_seconds + now - self._export_began)
        if part in ("track", "loading") and self.following_seconds > 0 and done > 0 and self._began is not None:
            tracking = (now - self._began) * (1 - done) / done if part == "track" else 0.0
            return tracking + self.following_seconds
        return None if seconds_left is None else seconds_left + self.export_seconds

    def _send(self, now: float, left: float | None, followed: FollowedPoints | None) -> None:
        self._sent = now
        self.on_progress(
            Progress.model_validate(
                {
                    **self._last,
                    "followed": followed,
                    "fraction": self._furthest,
                    "seconds_left": None if left is None else round(left, 1),
                    "updated_at": datetime.now(UTC),
                }
            )
        )

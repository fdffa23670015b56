"""Limits on one film. Every film process imports this module, so it does not import pydantic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pliant.schemas.film_limits import FilmLimits

if TYPE_CHECKING:
    from pliant.worker.settings import Settings


LONGEST_TRACKING = 604_800.0
"""Seconds of tracking where nothing else limits a job's time: one week, the largest `time_limit` of a job."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmBounds:
    """Limits on one film, and on the process that reads it."""

    limits: FilmLimits = FilmLimits()  # noqa: RUF009 - frozen

    check_seconds: float = 30.0
    """Wall time of the check at submission, seconds."""

    track_seconds: float = LONGEST_TRACKING
    """Wall time of tracking, seconds."""

    memory: int = 4 << 30
    """Address space of the film process, bytes."""

    scratch_bytes: int = 8 << 30
    """Size of one file written by that process, such as the losslessly packed grey frames of the film, bytes."""

    @classmethod
    def of(cls, settings: Settings, *, max_bytes: int = FilmLimits().bytes) -> FilmBounds:
        """Return the bounds of an installation; the memory and time limits of jobs also apply to the film process."""
        memory = min(settings.film_memory, settings.memory_limit or settings.film_memory)
        limits = FilmLimits(max_bytes, settings.film_frames, settings.film_pixels, settings.film_seconds)
        return cls(limits=limits, track_seconds=settings.time_limit or LONGEST_TRACKING, memory=memory)

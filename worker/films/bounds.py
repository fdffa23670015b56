"""Limits of one film. The film process, which starts for each film, loads this module without pydantic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.worker.settings import Settings


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmBounds:
    """Limits of one film; those on playing time and frames are enforced by `pliant.tracking.FilmLimits`."""

    max_bytes: int = 1 << 30
    """Size of the film's file, or of all pictures of a zip."""

    max_frames: int = 3600
    """Frames that are tracked."""

    max_pixels: int = 4096 * 2304
    """Width × height of a frame."""

    max_seconds: float = 600.0
    """Playing time up to the last frame that is tracked."""

    check_seconds: float = 30.0
    """Wall time of the check at submission."""

    track_seconds: float = 3600.0
    """Wall time of tracking."""

    memory: int = 4 << 30
    """Address space of the process that decodes."""

    scratch_bytes: int = 8 << 30
    """Size of one file that this process writes: the grey frames of the film, packed without loss."""

    @classmethod
    def of(cls, settings: Settings, *, max_bytes: int = 1 << 30) -> FilmBounds:
        """Return the bounds that an installation sets; a job's own limit on memory holds for its film, too."""
        memory = min(settings.film_memory, settings.memory_limit or settings.film_memory)
        return cls(
            max_bytes=max_bytes, max_frames=settings.film_frames, max_pixels=settings.film_pixels,
            max_seconds=settings.film_seconds, memory=memory,
        )  # fmt: skip

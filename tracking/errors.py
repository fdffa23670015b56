"""Errors of the tracker.

TrackingError              base: catch this one
├── FilmError              an unusable film, region or option; has expected, got and a hint
└── TrackingStopped        `should_stop` returned True
"""

from __future__ import annotations

from pliant.schemas.invalid import Invalid, Picklable

FILM_SLOWLY = "Film more slowly and with more light, so that successive frames overlap and are not blurred."
"""Hint for films in which points are lost."""


class TrackingError(Picklable):
    """The film could not be tracked."""


class TrackingStopped(TrackingError):
    """`should_stop` returned True; there is no result."""

    code = "stopped"

    def __init__(self) -> None:
        super().__init__("Tracking was stopped before it finished.")


class FilmError(Invalid, TrackingError):
    """A film, region or option cannot be used; the hint often suggests what to film instead."""

"""Errors of the tracker.

TrackingError              base: catch this one
├── FilmError              a film, region or option that cannot be used; states both sides and what to do
└── TrackingStopped        `should_stop` returned True
"""

from __future__ import annotations

from pliant.schemas.invalid import Invalid


class TrackingError(Exception):
    """The film could not be tracked."""


class TrackingStopped(TrackingError):
    """`should_stop` returned True; there is no result."""

    code = "stopped"

    def __init__(self) -> None:
        super().__init__("Tracking was stopped before it finished.")


class FilmError(Invalid, TrackingError):
    """A film, a region or an option that cannot be used; the hint often tells what to film instead."""

"""Errors of the tracker.

TrackingError              base: catch this one
├── FilmError              a film, region or option that cannot be used; states both sides and what to do
└── TrackingStopped        `should_stop` returned True
"""

from __future__ import annotations


class TrackingError(Exception):
    """The film could not be tracked."""


class TrackingStopped(TrackingError):
    """`should_stop` returned True; there is no result."""

    code = "stopped"

    def __init__(self) -> None:
        super().__init__("Tracking was stopped before it finished.")


class FilmError(TrackingError):
    """A film, a region or an option that cannot be used.

    Attributes
    ----------
    code : str
        Stable machine-readable name of the fault, e.g. ``"too_few_frames"``.
    field : str
        The input at fault, e.g. ``"film"`` or ``"region"``.
    expected, got : str
        Both sides, in words.
    hint : str
        What to do about it, often what to film instead.
    """

    def __init__(self, code: str, *, field: str, expected: str, got: str, hint: str) -> None:
        super().__init__(f"{field}: expected {expected}, got {got}. {hint}")
        self.code = code
        self.field = field
        self.expected = expected
        self.got = got
        self.hint = hint

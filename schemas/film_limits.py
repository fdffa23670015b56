"""Limits on the size of films."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FilmLimits:
    """Limits of one film; a film beyond any of them is rejected.

    The defaults admit a minute of 4K film from a phone.
    """

    bytes: int = 1 << 30
    """Size of the file, or of all pictures together."""

    frames: int = 3600
    """Number of selected frames."""

    pixels: int = 4096 * 2304
    """Width × height."""

    seconds: float = 600.0
    """Playing time up to the last selected frame."""

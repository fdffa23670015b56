"""The whole accuracy table as parts, small enough for one machine in one sitting.

The default settings, on clean tracks and against the headline's outliers, keep every point. The comparison of the methods and the trials
of the corruption table, hundreds of solves, are thinned: which method wins, and what noise, outliers and hidden points do to it, is settled
long before the points run out, and the table says how many there were.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from benchmarks.accuracy.cells import METHODS

CORRUPTED = ("facescan10_rot90", "facescan99_rot30", "aura_anim_rot45", "akhter_drink")
FACES = ("facescan10_rot90", "facescan99_rot30", "ict_beat_9k_rot30", "aura_anim_rot45")
THINNED = 1_000
SEEN = 700
"""Points of the table that takes every point as seen, as those who published figures on these sequences do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Some cells of the table."""

    only: tuple[str, ...] = ()
    points: int | None = None
    visibility: str = "file"
    corruptions: tuple[str, ...] = ("clean",)
    cameras: tuple[str, ...] = ("true", "estimated")
    methods: tuple[str, ...] = field(default=tuple(METHODS))
    trials: int = 5


PARTS = (
    Part(points=THINNED),
    Part(points=SEEN, visibility="all", methods=("temporal", "robust", "default")),
    Part(methods=("default",)),
    Part(only=FACES, corruptions=("outliers 10",), cameras=("estimated",), methods=("default",), trials=1),
    Part(only=CORRUPTED, points=THINNED, corruptions=("all",)),
)
"""In the order of what is wanted first; a later part skips what an earlier one has measured."""

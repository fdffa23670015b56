"""Parts of the full accuracy table, small enough to measure on one machine in one session.

The default settings keep every point, on clean tracks and with 10 % outliers. The method comparison and the corruption trials, hundreds of
solves, use thinned sequences: the ranking of the methods and the effect of corruptions settle at far fewer points. The table lists the
number used.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from benchmarks.accuracy.cells import METHODS

CORRUPTED = ("facescan10_rot90", "facescan99_rot30", "aura_anim_rot45", "akhter_drink")
FACES = ("facescan10_rot90", "facescan99_rot30", "ict_beat_9k_rot30", "aura_anim_rot45")
THINNED = 1_000
SEEN = 700
"""Points in the table that treats every point as visible, as published figures on these sequences do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A set of cells of the table."""

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
"""By decreasing priority; a part skips cells that an earlier one has measured."""

"""How much of a sequence is learned from, and solved, at once."""

from __future__ import annotations

from collections.abc import Iterator

from pliant.solver.pulse import pulse

LEARNED_FRAMES = 360
"""Maximum number of frames from which cameras and covariance are learned together, evenly spread over longer films; the others follow by
resection (`reconstruction.long_films`)."""

BLOCK_OBSERVATIONS = 10_000_000
"""Largest number of frames times points that are solved at once: 3 GB. Blocks cost time: a face of 50 × 40,000 takes 15 processor seconds
in four blocks and 12 at once, for the points that blocks share and the starts of which the weight of bending is computed."""

CHUNK_OBSERVATIONS = 1_000_000
"""Number of frames times points whose intermediate results are held at once where frames are treated one by one: 100 MB at most."""


def frame_chunks(frames: int, points: int) -> Iterator[slice]:
    """Yield consecutive frames, of `CHUNK_OBSERVATIONS` observations at most, or single ones; a pulse precedes each."""
    together = max(1, CHUNK_OBSERVATIONS // max(points, 1))
    for first in range(0, frames, together):
        pulse()
        yield slice(first, min(first + together, frames))

"""Limits on the frames and observations that are processed at once."""

from __future__ import annotations

from collections.abc import Iterator

from pliant.solver.pulse import pulse

LEARNED_FRAMES = 360
"""Maximum number of frames from which cameras and covariance are learned. Longer films use this many, evenly spread; the cameras of the
others follow by resection (`reconstruction.long_films`)."""

BLOCK_OBSERVATIONS = 10_000_000
"""Maximum number of frames times points solved at once: 3 GB. Blocks cost time, because they overlap and the weight of bending needs extra
starts: a face of 50 × 40,000 takes 15 processor seconds in four blocks and 12 in one."""

CHUNK_OBSERVATIONS = 1_000_000
"""Maximum number of frames times points whose intermediate results are held at once in computations frame by frame: 100 MB."""


def frame_chunks(frames: int, points: int) -> Iterator[slice]:
    """Yield slices of at most `CHUNK_OBSERVATIONS` observations, or of one frame if it has more; call `pulse` before each."""
    together = max(1, CHUNK_OBSERVATIONS // max(points, 1))
    for first in range(0, frames, together):
        pulse()
        yield slice(first, min(first + together, frames))

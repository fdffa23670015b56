"""Limits on the frames and observations that are processed at once."""

from __future__ import annotations

from collections.abc import Iterator

from pliant.solver.pulse import pulse

MAX_COORDINATE = 1e12
"""Largest absolute coordinate that is accepted, the tracks' unit; squares and fourth powers of far larger ones overflow."""

LEARNED_FRAMES = 240
"""Maximum number of frames of a film from which cameras and covariance are learned; of a longer one, every n-th frame is used, and the
cameras of the others follow by resection (`reconstruction.long_films`). More frames take longer where perspective is found, and the same
number of iterations converges less: the error of a dance is .096 from all of its 264 frames and .089 from every second."""

MAX_UNORDERED_FRAMES = 360
"""Maximum number of photographs. Cameras and prior are learned from all of them, because photographs cannot be interpolated."""

BLOCK_OBSERVATIONS = 10_000_000
"""Maximum number of frames times points solved at once: 3 GB. Blocks cost time, because they overlap and the weight of bending needs extra
starts: a face of 50 × 40,000 takes 15 processor seconds in four blocks and 12 in one."""

CHUNK_OBSERVATIONS = 1_000_000
"""Maximum number of frames times points whose intermediate results are held at once in computations frame by frame: 100 MB."""


def learned_stride(frames: int) -> int:
    """Return n, for learning from every n-th of this number of frames of a film."""
    return max(1, -(-frames // LEARNED_FRAMES))


def learned_frames(frames: int) -> int:
    """Return the number of frames that are learned from, of this number of frames of a film."""
    return -(-frames // learned_stride(frames))


def frame_chunks(frames: int, points: int) -> Iterator[slice]:
    """Yield slices of at most `CHUNK_OBSERVATIONS` observations, or of one frame if it has more; call `pulse` before each."""
    together = max(1, CHUNK_OBSERVATIONS // max(points, 1))
    for first in range(0, frames, together):
        pulse()
        yield slice(first, min(first + together, frames))

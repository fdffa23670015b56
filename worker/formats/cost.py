"""What a job will need, estimated from its size before it runs: memory of its process, and time.

Memory is a constant for the interpreter and the libraries, and a share for each of the F·P observations, since every array of the
solver and of the exporters is linear in them. Time is a share for each frame, for cameras and prior, and one for each observation.

Basis: whole jobs with the default options and outputs on one busy core, gallery faces (`python -m benchmarks.installation.cost`):

    frames × points   peak, MB   estimate   processor, s   estimate
    10 × 500               107        113            2.3        2.2
    10 × 5,000             130        140            2.5        2.6
    10 × 40,000            308        350            6.4        5.4
    50 × 500               127        125            8.9        9.2
    50 × 2,000             155        170            8.8        9.8
    50 × 10,000            337        410           12.9       13.0
    100 × 500              134        140           17.7       17.9

The peaks of the solver alone at 10 × 300,000 and 800 × 2,000 (benchmarks/results/growth.jsonl) lie below the estimate by at most a
third. Not covered: points seen in few frames, which take 80 bytes times the square of their number; and time with other options.
"""

from __future__ import annotations

from pliant.schemas.job import Estimate
from pliant.schemas.options import Options

LIBRARIES = 110_000_000
"""Bytes of a job process before it has read its inputs."""

BYTES = {"gaussian": 600, "smooth": 500, "smooth+low_rank": 500}
"""Bytes for each observation, by prior: up to 510 were measured for the solver alone, 520 with exports."""

SECONDS = 0.5
"""Processor seconds of a job that is as small as can be."""

CAMERAS, LEARNED_FRAMES = 0.17, 360
"""Processor seconds for each frame that cameras and prior are learned from, and the largest number of those."""

MICROSECONDS = 8.0
"""Processor time for each observation."""


def estimated(num_frames: int, num_points: int, options: Options) -> Estimate:
    """Estimate what a job of this size needs."""
    observations = num_frames * num_points
    return Estimate(
        memory_bytes=LIBRARIES + BYTES[options.prior] * observations,
        seconds=round(SECONDS + CAMERAS * min(num_frames, LEARNED_FRAMES) + MICROSECONDS * 1e-6 * observations, 1),
    )


def largest_that_fits(memory: int, num_frames: int, num_points: int, options: Options) -> tuple[int, int]:
    """Return how many points of these frames, and how many frames of these points, fit into so many bytes."""
    observations = max(0, memory - LIBRARIES) // BYTES[options.prior]
    return observations // max(1, num_frames), observations // max(1, num_points)

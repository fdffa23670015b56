"""Admission control: reject a job that needs more memory than any worker has, and suggest sizes that fit."""

from __future__ import annotations

from collections.abc import Iterable

from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.worker.errors import InvalidRequest
from pliant.worker.formats.cost import largest_that_fits


def check_fits(
    interpretation: Interpretation, options: Options, memories: Iterable[int], *, film: bool = False
) -> None:
    """Check that at least one worker has the estimated memory of a job.

    `memories` are the bytes available to a job on each running worker; if none is known, every job passes. `film` is true for a
    tracked film, of which only the worker that tracked it is considered.

    Raises
    ------
    InvalidRequest
        Code needs_more_memory.
    """
    estimate, largest = interpretation.estimate, max(memories, default=0)
    if estimate is None or largest == 0 or estimate.memory_bytes <= largest:
        return
    frames, count = interpretation.num_frames, interpretation.num_points
    points, fewer = largest_that_fits(largest, frames, count, options)
    ways = [f"max_points={points}"] if points >= 4 else []
    ways += [f"at most {fewer} frames (option frames)"] if fewer >= 3 else []
    hint = f"{' or '.join(ways)} would fit." if ways else "Ask the operator for a worker with more memory."
    if film and ways:
        hint += " A retry may run on a larger worker."
    raise InvalidRequest(
        "needs_more_memory", field="film" if film else "tracks",
        expected=f"at most {_gigabytes(largest)}, the memory of {'this' if film else 'the largest'} worker",
        got=f"about {_gigabytes(estimate.memory_bytes)} for {frames} frames × {count} points",
        hint=hint,
    )  # fmt: skip


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.1f} GB"

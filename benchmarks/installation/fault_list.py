"""The list of faults, and functions that the faults share."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from pliant.client import Job, NotAllowedNow
from pliant.solver.gallery import face

from benchmarks.installation.instance import Instance
from benchmarks.installation.long_jobs import LONG, long_sequence

SHORT = {"max_reweightings": 3}
LARGE = {"method": "pseudo_inverse"}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a fault."""

    record: str
    """Final state of the job record."""
    seconds: float
    """Time from the fault to that state."""


Fault = Callable[[Instance], Outcome]
FAULTS: dict[str, tuple[str, Fault]] = {}
"""Description and function of each fault by name."""


def fault(when: str) -> Callable[[Fault], Fault]:
    """Register a fault with its description."""

    def listed(function: Fault) -> Fault:
        FAULTS[function.__name__] = (when, function)
        return function

    return listed


def submitted(instance: Instance, *, frames: int = 40, points: int = 1200, options: dict[str, object]) -> str:
    """Submit a synthetic sequence over HTTP, with true cameras so that the main loop starts soon."""
    sequence = long_sequence() if options is LONG else face(frames, points)
    with instance.client() as client:
        job = client.submit(
            sequence.tracks.points, mesh="none", rotations=sequence.rotations, options=options, timeout=120
        )
    instance.acknowledged.append(job.id)
    return job.id


def status_of(job: Job) -> str:
    """Return the final status of a job as text."""
    again = f", attempt {job.attempt}" if job.attempt > 1 else ""
    return job.status.value + (f" ({job.error.code})" if job.error is not None else "") + again


def cancelled(instance: Instance, id: str) -> Job:
    """Cancel a job and return its final record."""
    with suppress(NotAllowedNow), instance.client() as client:
        client.cancel(id)
    return instance.final(id)

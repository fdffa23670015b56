"""The list of faults, and what those who commit them have in common."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from pliant.client import Job, NotAllowedNow
from pliant.solver.gallery import face

from benchmarks.installation.house import House
from benchmarks.installation.long_jobs import LONG, long_sequence

SHORT = {"max_reweightings": 3}
LARGE = {"method": "pseudo_inverse"}


@dataclass(frozen=True)
class Told:
    """What came of a fault."""

    said: str
    """By the record, in the end."""
    seconds: float
    """From the fault to that."""


Fault = Callable[[House], Told]
FAULTS: dict[str, tuple[str, Fault]] = {}
"""What was done and when, and how it is done, by a short name."""


def fault(when: str) -> Callable[[Fault], Fault]:
    """List a fault."""

    def listed(function: Fault) -> Fault:
        FAULTS[function.__name__] = (when, function)
        return function

    return listed


def submitted(house: House, *, frames: int = 40, points: int = 1200, options: dict[str, object]) -> str:
    """Submit a made-up sequence over HTTP; true cameras, so that the solver is soon at its loop."""
    sequence = long_sequence() if options is LONG else face(frames, points)
    with house.client() as client:
        job = client.submit(
            sequence.tracks.points, mesh="none", rotations=sequence.rotations, options=options, timeout=120
        )
    house.acknowledged.append(job.id)
    return job.id


def said(job: Job) -> str:
    """Return a job's end in a few words."""
    again = f", attempt {job.attempt}" if job.attempt > 1 else ""
    return job.status.value + (f" ({job.error.code})" if job.error is not None else "") + again


def cancelled(house: House, id: str) -> Job:
    """Cancel a job that has shown what it had to show."""
    with suppress(NotAllowedNow), house.client() as client:
        client.cancel(id)
    return house.final(id)

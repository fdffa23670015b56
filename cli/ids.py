"""Job ids on the command line: a complete id, a unique prefix, or ``@last``."""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pliant.client import Client, RemoteJob

LAST = "@last"
SEARCHED = 1000
"""Number of newest jobs that are searched for a prefix."""


def find_job(client: Client, text: str) -> RemoteJob:
    """Return the job for a complete id, a unique prefix, or ``@last``, the newest job.

    Raises
    ------
    NotFound
        No job matches, or ``@last`` was given and there is no job yet.
    BadArgument
        The text is malformed, or more than one job matches.
    """
    from pliant.client import BadArgument, NotFound
    from pliant.schemas.job import LARGEST_PAGE, Problem
    from pliant.schemas.problems import ProblemCode

    if text == LAST:
        for job in client.list(page_size=1):
            return job
        raise NotFound(
            Problem.of(
                ProblemCode.UNKNOWN_JOB,
                detail="@last: there are no jobs yet. Submit one with `pliant submit FILE`, a track file or a film.",
            )
        )
    try:
        return client.get(text)
    except NotFound:
        fitting = [job for job in islice(client.list(page_size=LARGEST_PAGE), SEARCHED) if job.id.startswith(text)]
        if len(fitting) == 0:
            raise
    if len(fitting) > 1:
        ids = ", ".join(job.id for job in fitting[:5]) + (", …" if len(fitting) > 5 else "")
        raise BadArgument(f"{text}: {len(fitting)} jobs begin with it ({ids}). Give more characters.")
    return fitting[0]

"""From what went wrong in a job to the problem in its record: one table, in words for the user."""

from __future__ import annotations

import errno
import os
import signal

from pliant.schemas.invalid import Invalid, members_of
from pliant.schemas.job import Problem
from pliant.worker.errors import StoreUnavailable, TimedOut

_NO_ROOM_FOR_A_THREAD = ("can't start new thread", os.strerror(errno.EAGAIN))
"""What Python and SciPy's pool say when a thread's stack does not fit into the address space."""


def problem_of(error: BaseException, *, memory_limit: int = 0) -> Problem:
    """Return the problem that an exception in a job is. The traceback belongs into the log, never into the record.

    Parameters
    ----------
    memory_limit : int
        Address space the job may take, bytes; 0: no limit.
    """
    if isinstance(error, Invalid):
        return Problem.of(error.code, 422, detail=_sentence(str(error)), **members_of(error))
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return out_of_memory(memory_limit)
    if memory_limit and isinstance(error, RuntimeError) and str(error) in _NO_ROOM_FOR_A_THREAD:
        return out_of_memory(memory_limit)
    if isinstance(error, TimedOut):
        return Problem.of(error.code, detail=str(error), field="options.time_limit")
    if isinstance(error, StoreUnavailable):
        return Problem.of(error.code, detail=str(error))
    if isinstance(error, OSError) and error.errno is not None:
        reason = os.strerror(error.errno)
        detail = f"A file could not be read or written ({reason}). Free space or mend the disk, then retry the job."
        return Problem.of("storage_failed", detail=detail)
    return Problem.of(
        "internal_error",
        detail=f"The job failed with an unexpected {type(error).__name__}; this is our fault, not yours. "
        "The job's log has the details: please report them.",
    )


def out_of_memory(limit: int = 0) -> Problem:
    """Return the problem of a job that needed more memory than there was."""
    there = f"{limit / 2**30:.1f} GiB" if limit else "the machine had"
    return Problem.of(
        "out_of_memory",
        detail=f"The job needed more memory than {there}. Send fewer points or frames, set precision to float32, "
        "or retry where there is more memory.",
    )


def timed_out(limit: float) -> Problem:
    """Return the problem of a job that took longer than it may."""
    return Problem.of(
        "timed_out",
        detail=f"The job took longer than the {limit:g} s it may. Send fewer points or frames, lower max_reweightings, "
        "or have the operator raise PLIANT_TIME_LIMIT.",
    )


def worker_lost(reason: str) -> Problem:
    """Return the problem of a job whose process ended without a last word."""
    return Problem.of("worker_lost", detail=f"{reason} Nothing else is affected; retry the job.")


def how_it_ended(status: int) -> str:
    """Say in words what a wait status means."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return f"The process that worked on the job was ended by signal {number} ({signal.Signals(number).name})."
    return f"The process that worked on the job ended with code {os.WEXITSTATUS(status)} and no last word."


def _sentence(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else f"{text}."

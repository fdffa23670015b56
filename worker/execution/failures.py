"""From what went wrong in a job to the problem in its record: one table, in words for the user."""

from __future__ import annotations

import errno
import os
import signal

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
    from pliant.solver import (
        InvalidInput,
    )  # here, because it loads NumPy, which the reconciler has no use for

    if isinstance(error, InvalidInput):
        return Problem(
            title="The input cannot be solved", status=422, detail=_sentence(str(error)), code=error.code,
            field=error.field, expected=error.expected, got=error.got, hint=error.hint,
        )  # fmt: skip
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return out_of_memory(memory_limit)
    if memory_limit and isinstance(error, RuntimeError) and str(error) in _NO_ROOM_FOR_A_THREAD:
        return out_of_memory(memory_limit)
    if isinstance(error, TimedOut):
        return Problem(
            title="Timed out",
            status=504,
            detail=str(error),
            code=error.code,
            field="options.time_limit",
            retryable=True,
        )
    if isinstance(error, StoreUnavailable):
        return Problem(title="Storage failed", status=503, detail=str(error), code=error.code, retryable=True)
    if isinstance(error, OSError) and error.errno is not None:
        reason = os.strerror(error.errno)
        return Problem(
            title="Storage failed", status=503, code="storage_failed", retryable=True,
            detail=f"A file could not be read or written ({reason}). Free space or mend the disk, then retry the job.",
        )  # fmt: skip
    return Problem(
        title="Internal error", status=500, code="internal_error",
        detail=f"The job failed with an unexpected {type(error).__name__}; this is our fault, not yours. "
        "The job's log has the details: please report them.",
    )  # fmt: skip


def out_of_memory(limit: int = 0) -> Problem:
    """Return the problem of a job that needed more memory than there was."""
    there = f"{limit / 2**30:.1f} GiB" if limit else "the machine had"
    return Problem(
        title="Out of memory", status=507, code="out_of_memory", retryable=True,
        detail=f"The job needed more memory than {there}. Send fewer points or frames, set precision to float32, "
        "or retry where there is more memory.",
    )  # fmt: skip


def timed_out(limit: float) -> Problem:
    """Return the problem of a job that took longer than it may."""
    return Problem(
        title="Timed out", status=504, code="timed_out", retryable=True,
        detail=f"The job took longer than the {limit:g} s it may. Send fewer points or frames, lower max_reweightings, "
        "or have the operator raise PLIANT_TIME_LIMIT.",
    )  # fmt: skip


def worker_lost(reason: str) -> Problem:
    """Return the problem of a job whose process ended without a last word."""
    return Problem(
        title="Worker lost", status=503, code="worker_lost", retryable=True,
        detail=f"{reason} Nothing else is affected; retry the job.",
    )  # fmt: skip


def how_it_ended(status: int) -> str:
    """Say in words what a wait status means."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return f"The process that worked on the job was ended by signal {number} ({signal.Signals(number).name})."
    return f"The process that worked on the job ended with code {os.WEXITSTATUS(status)} and no last word."


def _sentence(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else f"{text}."

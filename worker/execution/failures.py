"""Map exceptions of a job to the problems in its record."""

from __future__ import annotations

import errno
import os
import signal

from pliant.schemas.job import Problem
from pliant.worker.errors import StoreUnavailable, TimedOut

_NO_ROOM_FOR_A_THREAD = ("can't start new thread", os.strerror(errno.EAGAIN))
"""Messages of Python and SciPy when a thread's stack does not fit into the address space."""


def problem_of(error: BaseException, *, memory_limit: int = 0) -> Problem:
    """Return the problem for an exception in a job. Tracebacks go to the log, never into the record.

    Parameters
    ----------
    memory_limit : int
        Limit of the job's address space, bytes; 0: no limit.
    """
    from pliant.solver import (
        InvalidInput,
    )  # imported here because it loads NumPy, which the reconciler does not need

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
            detail=f"A file could not be read or written ({reason}). Free disk space or repair the disk, then retry the job.",
        )  # fmt: skip
    return Problem(
        title="Internal error", status=500, code="internal_error",
        detail=f"The job failed with an unexpected {type(error).__name__}; this is a defect of Pliant. "
        "Please report it with the job's log, which has the details.",
    )  # fmt: skip


def out_of_memory(limit: int = 0) -> Problem:
    """Return the problem of a job that ran out of memory."""
    there = f"{limit / 2**30:.1f} GiB" if limit else "the machine has"
    return Problem(
        title="Out of memory", status=507, code="out_of_memory", retryable=True,
        detail=f"The job needed more memory than {there}. Send fewer points or frames, set precision to float32, "
        "or retry where there is more memory.",
    )  # fmt: skip


def timed_out(limit: float) -> Problem:
    """Return the problem of a job that exceeded its time limit."""
    return Problem(
        title="Timed out", status=504, code="timed_out", retryable=True,
        detail=f"The job exceeded the time limit of {limit:g} s. Send fewer points or frames, lower max_reweightings, "
        "or ask the operator to raise PLIANT_TIME_LIMIT.",
    )  # fmt: skip


def worker_lost(reason: str) -> Problem:
    """Return the problem of a job whose process ended without recording an outcome."""
    return Problem(
        title="Worker lost", status=503, code="worker_lost", retryable=True,
        detail=f"{reason} Other jobs are not affected; retry this one.",
    )  # fmt: skip


def how_it_ended(status: int) -> str:
    """Return a sentence for a wait status."""
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        return f"The job process was ended by signal {number} ({signal.Signals(number).name})."
    return f"The job process ended with code {os.WEXITSTATUS(status)} without recording an outcome."


def _sentence(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else f"{text}."

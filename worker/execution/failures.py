"""Map exceptions of a job to the problems in its record."""

from __future__ import annotations

import errno
import os
import signal

from pliant.schemas.invalid import Invalid, members_of
from pliant.schemas.job import Problem
from pliant.worker.errors import StoreUnavailable, TimedOut

UNRECORDED = os.EX_TEMPFAIL
"""Exit code of a job process that the store of records did not let record its outcome."""

FOREIGN_STORE = os.EX_CONFIG
"""Exit code of a job process that found no job's files in its blob store."""

_NO_THREADS = ("can't start new thread", os.strerror(errno.EAGAIN))
"""Messages of Python and SciPy when a thread's stack does not fit into the address space."""


def problem_of(error: BaseException, *, memory_limit: int = 0) -> Problem:
    """Return the problem for an exception in a job. Tracebacks go to the log, never into the record."""
    if isinstance(error, Invalid):
        return Problem.of(error.code, 422, detail=_sentence(str(error)), **members_of(error))
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return out_of_memory(memory_limit)
    if memory_limit and isinstance(error, RuntimeError) and str(error) in _NO_THREADS:
        return out_of_memory(memory_limit)
    if isinstance(error, TimedOut):
        return Problem.of(error.code, detail=str(error), field="options.time_limit")
    if isinstance(error, StoreUnavailable):
        return Problem.of(error.code, detail=str(error))
    if isinstance(error, OSError) and error.errno is not None:
        reason = os.strerror(error.errno)
        detail = (
            f"A file could not be read or written ({reason}). Free disk space or repair the disk, then retry the job."
        )
        return Problem.of("storage_failed", detail=detail)
    if isinstance(error, FileNotFoundError):  # of the blob store: those of the system have a number
        detail = (
            "A stored file of the job is missing in the blob store of its worker. Check that PLIANT_BLOB_URL names the same one for the "
            "worker as for the service, then retry the job; if it does, the file was lost: submit the job again."
        )
        return Problem.of("storage_failed", detail=detail)
    return Problem.of(
        "internal_error",
        detail=f"The job failed with an unexpected {type(error).__name__}; this is a defect of Pliant. "
        "Please report it with the job's log, which has the details.",
    )


def out_of_memory(limit: int = 0) -> Problem:
    """Return the problem of a job that ran out of memory."""
    there = f"{limit / 2**30:.1f} GiB" if limit else "the machine has"
    return Problem.of(
        "out_of_memory",
        detail=f"The job needed more memory than {there}. Send fewer points or frames, "
        "or retry where there is more memory.",
    )


def timed_out(limit: float) -> Problem:
    """Return the problem of a job that exceeded its time limit."""
    return Problem.of(
        "timed_out",
        detail=f"The job exceeded the time limit of {limit:g} s. Send fewer points or frames, "
        "or ask the operator to raise PLIANT_TIME_LIMIT.",
    )


def worker_lost(reason: str) -> Problem:
    """Return the problem of a job whose process ended without recording an outcome."""
    return Problem.of("worker_lost", detail=f"{reason} Other jobs are not affected; retry this one.")


def how_it_ended(status: int) -> str:
    """Return a sentence for a wait status."""
    if os.WIFSIGNALED(status):
        return f"The job process was ended by signal {_named(os.WTERMSIG(status))}."
    if was_unrecorded(status):
        return "The job store did not answer when the job ended."
    if was_foreign(status):
        return "The files of the job are not in the blob store of its worker, nor are those of other jobs."
    return f"The job process ended with code {os.WEXITSTATUS(status)} without recording an outcome."


def was_unrecorded(status: int) -> bool:
    """Return True if by its wait status a job process ended because the store did not take its outcome."""
    return os.WIFEXITED(status) and os.WEXITSTATUS(status) == UNRECORDED


def was_foreign(status: int) -> bool:
    """Return True if by its wait status a job process ended because no job has its files in the blob store."""
    return os.WIFEXITED(status) and os.WEXITSTATUS(status) == FOREIGN_STORE


def _named(number: int) -> str:
    """Return the number of a signal with its name, if it has one: most real-time signals have none."""
    try:
        return f"{number} ({signal.Signals(number).name})"
    except ValueError:
        return str(number)


def _sentence(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else f"{text}."

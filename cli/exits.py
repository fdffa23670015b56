"""Exit codes of the command line, and which fault ends with which."""

from __future__ import annotations

import sys
from enum import IntEnum
from importlib import import_module
from typing import Any

from typer.core import TyperGroup


class Exit(IntEnum):
    """How a command ended. Documented in docs/reference/cli.md; a test holds the two together."""

    DONE = 0
    """Everything asked for was done."""
    FAILED = 1
    """The job failed or was cancelled, or its result is not good enough."""
    USAGE = 2
    """The command line itself is wrong."""
    REFUSED = 3
    """An input or an option is wrong; the message says what was expected and what was got."""
    UNREACHABLE = 4
    """No service answered, or it is at fault."""
    NOT_FOUND = 5
    """There is no such job, file or token."""
    NOT_NOW = 6
    """The job's status, the token, or another Pliant on the same data does not allow it."""
    TIME_IS_UP = 7
    """The time given was not enough; the job goes on."""
    UNHEALTHY = 8
    """`doctor` found something that has to be put right."""
    INTERRUPTED = 130
    """Ctrl-C."""


_CODES: tuple[tuple[str, str, Exit], ...] = (
    ("pliant.client.errors", "JobEnded", Exit.FAILED),
    ("pliant.client.errors", "TimeIsUp", Exit.TIME_IS_UP),
    ("pliant.client.errors", "InvalidRequest", Exit.REFUSED),
    ("pliant.client.errors", "BadArgument", Exit.REFUSED),
    ("pliant.client.errors", "NotFound", Exit.NOT_FOUND),
    ("pliant.client.errors", "NotAllowedNow", Exit.NOT_NOW),
    ("pliant.client.errors", "NotAuthorized", Exit.NOT_NOW),
    ("pliant.client.errors", "PliantError", Exit.UNREACHABLE),
    ("pliant.solver.errors", "InvalidInput", Exit.REFUSED),
    ("pliant.solver.errors", "SolverError", Exit.FAILED),
    ("pliant.tracking.errors", "TrackingError", Exit.REFUSED),
    ("pliant.worker.errors", "InvalidSetting", Exit.REFUSED),
    ("pliant.worker.errors", "InvalidRequest", Exit.REFUSED),
    ("pliant.worker.errors", "UnknownToken", Exit.NOT_FOUND),
    ("pliant.worker.errors", "DataDirectoryInUse", Exit.NOT_NOW),
    ("pliant.worker.errors", "WorkerError", Exit.UNREACHABLE),
)
"""The first line that fits counts. By name, so that nothing is loaded that the command did not load itself."""


def code_of(fault: BaseException) -> Exit | None:
    """Return the exit code for a fault that has a sentence for the user; None for a defect, which keeps its traceback."""
    if isinstance(fault, KeyboardInterrupt):
        return Exit.INTERRUPTED
    for module, name, code in _CODES:
        if module in sys.modules and isinstance(fault, getattr(import_module(module), name, ())):
            return code
    return None


class Guarded(TyperGroup):
    """The group of all commands: turns faults into a sentence and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except (Exception, KeyboardInterrupt) as fault:
            code = code_of(fault)
            if code is None:
                raise
            from pliant.cli.show import show_fault

            show_fault(fault, code, as_json=bool(ctx.obj is not None and ctx.obj.json))
            ctx.exit(code)

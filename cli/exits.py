"""Exit codes of the command line, and the errors that lead to them."""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from importlib import import_module
from itertools import pairwise
from typing import Any

from pliant.cli.extras import SERVER_MODULES, MissingExtra
from typer.core import TyperGroup


class Exit(IntEnum):
    """Exit code of a command. docs/reference/cli.md lists the codes; a test compares the two."""

    DONE = 0
    """The command succeeded."""
    FAILED = 1
    """The job failed or was cancelled, or its result is not good enough."""
    USAGE = 2
    """The command line is invalid."""
    REFUSED = 3
    """An input, an option or a path is invalid; the message states what was expected."""
    UNREACHABLE = 4
    """No service answered, or the service failed."""
    NOT_FOUND = 5
    """The service has no such job or file, or there is no such token."""
    NOT_NOW = 6
    """The job's status, the token, or another Pliant on the same data does not allow the command."""
    TIMEOUT = 7
    """`--timeout` passed; the job continues."""
    UNHEALTHY = 8
    """`doctor` or `fsck` found a fault, or the command needs an extra that is not installed."""
    INTERRUPTED = 130
    """Ctrl-C, SIGTERM or SIGHUP."""


_CODES: tuple[tuple[str, str, Exit], ...] = (
    ("pliant.cli.extras", "MissingExtra", Exit.UNHEALTHY),
    ("pliant.client.errors", "JobEnded", Exit.FAILED),
    ("pliant.client.errors", "WaitTimeout", Exit.TIMEOUT),
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
    ("pliant.worker.errors", "BadBackup", Exit.REFUSED),
    ("pliant.worker.errors", "NewerData", Exit.NOT_NOW),
    ("pliant.worker.errors", "TimedOut", Exit.FAILED),
    ("pliant.worker.errors", "WorkerError", Exit.UNREACHABLE),
)
"""Exit codes of error classes; the first match applies. Classes are given by name, so that no module is imported for the lookup."""


_STORAGE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
"""Errors of a file system, which name no file if they occur while writing."""


def code_of(fault: BaseException) -> Exit | None:
    """Return the exit code of an expected error, or None for a bug, whose traceback is shown."""
    if isinstance(fault, KeyboardInterrupt):
        return Exit.INTERRUPTED
    for module, name, code in _CODES:
        if module in sys.modules and isinstance(fault, getattr(import_module(module), name, ())):
            return code
    if isinstance(fault, OSError) and (fault.filename is not None or fault.errno in _STORAGE):
        return Exit.REFUSED
    return None


def sentence_of(fault: BaseException, job: str | None = None, *, others: int = 0) -> str:
    """Return the message for an error that ended a command.

    `job` is the id of the job that the command was waiting for; `others` is the number of further submitted, unfinished jobs.
    """
    if isinstance(fault, KeyboardInterrupt):
        return "Interrupted." if job is None else f"Interrupted. {_how_to_return(job, others)}"
    if job is not None and f"during the wait for job {job}" in str(fault):
        from pliant.client.retry import CALL_AGAIN

        # A repeated `pliant submit` without id or key would submit a second job.
        return str(fault).replace(CALL_AGAIN, _how_to_return(job, others))
    if hasattr(fault, "format_message"):  # of Click or Typer
        return str(fault.format_message())
    if isinstance(fault, OSError) and fault.strerror is not None and type(fault).__module__ == "builtins":
        name = "" if fault.filename is None else f"{os.fsdecode(fault.filename)}: "
        return f"{name}{fault.strerror}."
    return str(fault) or type(fault).__name__


def _how_to_return(job: str, others: int) -> str:
    """Return a sentence on how to follow the job that the command was waiting for, and `others`."""
    if others > 0:
        rest = "1 other" if others == 1 else f"{others} others"
        return (
            f"Job {job} and {rest} continue: repeat the command to follow all of them, "
            f"`pliant watch {job}` follows this one, `pliant cancel {job}` stops it."
        )
    return f"Job {job} continues: `pliant watch {job}` follows it, `pliant cancel {job}` stops it."


OF_PYDANTIC = "Value error, "
"""What pydantic writes before the message about an invalid choice."""


class Guarded(TyperGroup):
    """Group of all commands, which turns errors into a message and an exit code."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command and its arguments, of which none may be empty: a path would stand for the current folder.

        Raises
        ------
        BadArgument
            An argument is empty, and is not the value of an option that is empty by default.
        """
        from pliant.client.errors import BadArgument

        name, command, rest = super().resolve_command(ctx, args)
        blank = (
            {spelled for each in command.params if each.default == "" for spelled in each.opts} if command else set()
        )
        if any(text == "" and before not in blank for before, text in pairwise(["", *rest])):
            raise BadArgument(
                "Expected a path or a value, got an empty argument. Check the variable that it comes from."
            )
        return name, command, rest

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        as_json = "--json" in ctx.args
        try:
            with end_in_order():
                return super().invoke(ctx)
        except (Exception, KeyboardInterrupt) as caught:
            fault: BaseException = caught
            if isinstance(fault, ModuleNotFoundError) and (fault.name or "").partition(".")[0] in SERVER_MODULES:
                fault = MissingExtra(f"pliant {ctx.invoked_subcommand or ''}".strip())
            fault = _of_setting(fault) or fault
            code = code_of(fault)
            if code is None:
                if str(getattr(fault, "message", "")).startswith(OF_PYDANTIC):
                    fault.message = fault.message.removeprefix(OF_PYDANTIC)  # type: ignore[attr-defined]
                if hasattr(fault, "option_name") and hasattr(fault, "possibilities"):
                    _suggest(fault)
                if not (as_json and hasattr(fault, "format_message")):
                    raise
                code = Exit.USAGE
            from pliant.cli.show import show_fault

            session = ctx.obj
            sentence = sentence_of(fault, getattr(session, "following", None), others=getattr(session, "others", 0))
            show_fault(fault, sentence, code, as_json=as_json, url=getattr(session, "url", None))
            ctx.exit(code)


def _of_setting(fault: Any) -> BaseException | None:
    """Return the error of a setting whose environment variable was rejected as the value of an option; None for other errors.

    So a variable leads to the same message, whichever process reads it.
    """
    parameter, context = getattr(fault, "param", None), getattr(fault, "ctx", None)
    if parameter is None or context is None or os.environ.get(parameter.envvar or "", "") == "":
        return None
    source = context.get_parameter_source(parameter.name)
    if source is None or source.name != "ENVIRONMENT":
        return None
    try:
        from pliant.service.settings import ServiceSettings
        from pliant.worker.settings import Settings
    except ImportError:  # of a client without the extra
        return None
    from pliant.worker.errors import InvalidSetting

    try:
        Settings.from_environment()
        ServiceSettings.from_environment()
    except InvalidSetting as error:
        return error
    return None


def _suggest(fault: Any) -> None:
    """Complete a `NoSuchOption` of Typer: with the option that was meant, or with `-O` for an option of the reconstruction.

    The class of the error is Click's or Typer's own, depending on the version of Typer.
    """
    from pliant.schemas.options import Options
    from pliant.schemas.suggestions import closest

    name = str(fault.option_name).lstrip("-").replace("-", "_")
    own = {
        spelled.removeprefix("--").replace("-", "_"): spelled
        for parameter in fault.ctx.command.params
        for spelled in parameter.opts
        if spelled.startswith("--")
    }
    meant = closest(name, own)
    if "option" in own and name in Options.model_fields:
        fault.message += f". It is an option of the reconstruction: -O {name}=VALUE"
        fault.possibilities = []
    elif meant is not None:
        fault.possibilities = [own[meant]]
    elif "option" in own and (name := closest(name, Options.model_fields) or ""):
        fault.message += f". An option of the reconstruction is given as -O {name}=VALUE"


@contextmanager
def end_in_order() -> Iterator[None]:
    """Make SIGTERM and the end of the terminal work like Ctrl-C, so that processes end and temporary files are removed."""
    main = threading.current_thread() is threading.main_thread()  # only there can handlers be set
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if main and hasattr(signal, name)]
    numbers = [each for each in numbers if signal.getsignal(each) != signal.SIG_IGN]  # as with nohup
    handlers = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)

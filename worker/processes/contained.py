"""Run a module of this package in a process of its own that has limits, and get its answer or its refusal.

Two processes are started this way: the isolated reader, which reads large inputs, and the sandbox, which parses formats whose
parsers are not trusted. Both receive a JSON request on standard input and write a JSON answer to standard output, which is a
temporary file, so that the parent never holds more than `MAX_ANSWER` bytes of it. Both end with their parent.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pliant.solver.errors import InvalidInput
from pliant.worker.processes.containment import die_with_parent

DONE, REFUSED = 0, 3
"""Exit codes of a process that answered, and of one that refused its input."""

MAX_ANSWER = 1 << 20
"""Bytes of an answer that the parent reads."""

ERRORS_KEPT = 4096
"""Bytes of standard error that the parent reads."""

PARTS = ("code", "field", "expected", "got", "hint")
"""Attributes of `InvalidInput` that a refusal carries."""


@dataclass(frozen=True, slots=True)
class Ended:
    """How a contained process ended."""

    code: int
    """Exit code; negative: the signal that ended it."""

    answer: bytes
    errors: str
    """End of its standard error."""

    overdue: bool = False
    """True if it was killed because it took too long."""


def run_contained(
    module: str,
    request: Mapping[str, Any],
    *,
    seconds: float,
    directory: str | None = None,
    descriptors: tuple[int, ...] = (),
    environment: Mapping[str, str] | None = None,
) -> Ended:
    """Start `python -I -m module`, wait for it, and return how it ended. It inherits nothing but what is passed.

    Parameters
    ----------
    module : str
        A module whose `main` calls `serve`.
    request : mapping
        JSON for the process.
    seconds : float
        Wall time after which it is killed.
    directory : str, optional
        Its working directory.
    descriptors : tuple of int
        Open files that it inherits.
    environment : mapping, optional
        Variables it gets besides those that keep the numerical libraries to one thread.
    """
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as answer, tempfile.TemporaryFile() as errors:
        given.write(json.dumps(dict(request)).encode())
        given.seek(0)
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-I", "-m", module, str(os.getpid())], env={**(environment or {}), **threads},
            stdin=given, stdout=answer, stderr=errors, pass_fds=descriptors, cwd=directory,
        )  # fmt: skip
        overdue = False
        try:
            process.wait(timeout=seconds)
        except subprocess.TimeoutExpired:
            overdue = True
        finally:
            if process.returncode is None:
                process.kill()
                process.wait()
        answer.seek(0)
        errors.seek(max(0, errors.seek(0, os.SEEK_END) - ERRORS_KEPT))
        last = errors.read().decode(errors="replace")
        return Ended(process.returncode, answer.read(MAX_ANSWER + 1), last, overdue)


def refusal_in(ended: Ended) -> dict[str, Any] | None:
    """Return the parts of the refusal that a process wrote, `choices` among them; None if they cannot be read."""
    try:
        stated = json.loads(ended.answer)
        parts: dict[str, Any] = {name: str(stated[name]) for name in PARTS}
    except (ValueError, KeyError, TypeError):
        return None
    return parts | {"choices": stated.get("choices")}


def serve(handle: Callable[[dict[str, Any]], str]) -> int:
    """Be the contained process: read the request, call `handle`, write its answer or its refusal; return the exit code."""
    die_with_parent(int(sys.argv[1]))
    try:
        answer, code = handle(json.load(sys.stdin)), DONE
    except InvalidInput as error:
        stated = {name: getattr(error, name) for name in PARTS}
        answer, code = json.dumps({**stated, "choices": getattr(error, "choices", None)}), REFUSED
    sys.stdout.write(answer)
    sys.stdout.flush()
    return code


def limit_process(limits: Mapping[int, int]) -> None:
    """Set resource limits for the rest of the process's life; one that the system does not know is passed over."""
    for name, bound in limits.items():
        with suppress(ValueError, OSError):  # macOS has no limit on the address space
            _, hard = resource.getrlimit(name)
            most = bound if hard == resource.RLIM_INFINITY else min(bound, hard)
            resource.setrlimit(name, (most, most))

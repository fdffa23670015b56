"""Run a module of this package in a separate process with resource limits, and return its answer or its rejection.

Three processes are started this way: the isolated reader, which reads large inputs; the sandbox, which runs untrusted parsers;
and the film process, which decodes and tracks films. Each receives a JSON request on standard input, writes a JSON answer to standard
output, and ends with its parent. Standard output is a temporary file, of which the parent reads at most `MAX_ANSWER` bytes.
Long-running processes may send progress over a pipe, one JSON object per line.
"""

from __future__ import annotations

import errno
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pliant.schemas.invalid import Invalid, members_of
from pliant.worker.processes.containment import NUMERICAL_THREADS, die_with_parent

DONE, REFUSED, DISK_FULL = 0, 3, 4
"""Exit codes of a process that succeeded, of one that rejected its input, and of one that found the disk full."""

MAX_ANSWER = 1 << 20
"""Maximum bytes of an answer that the parent reads."""

ERRORS_KEPT = 4096
"""Maximum bytes of standard error that the parent reads."""

MAX_LINE = 4096
"""Maximum bytes kept of a line of progress that has not ended yet; a longer one is dropped."""

POLL = 0.1
"""Seconds between two calls of `should_stop`."""


@dataclass(frozen=True, slots=True)
class Ended:
    """How a contained process ended."""

    code: int
    """Exit code; negative: the signal that ended it."""

    answer: bytes
    errors: str
    """End of its standard error."""

    overdue: bool = False
    """Whether it was killed at its time limit."""

    stopped: bool = False
    """Whether it was killed because `should_stop` returned True."""


def run_contained(
    module: str,
    request: Mapping[str, Any],
    *,
    seconds: float,
    directory: str | None = None,
    descriptors: tuple[int, ...] = (),
    environment: Mapping[str, str] | None = None,
    on_line: Callable[[dict[str, Any]], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Ended:
    """Run `python -I -m module`, whose `main` calls `serve`, and return how it ended. It inherits only what is passed here.

    It is killed after `seconds` of wall time, or once `should_stop`, called every `POLL` seconds, returns True. Its environment
    consists of `environment` and the variables that limit the numerical libraries to one thread. `on_line` is called with every
    JSON object that it writes to the descriptor `progress` of its request.

    Raises
    ------
    OSError
        ENOSPC: the disk is full, here or for the process.
    """
    threads = dict.fromkeys(NUMERICAL_THREADS, "1")
    with (
        _Progress(on_line) as progress,
        tempfile.TemporaryFile() as given,
        tempfile.TemporaryFile() as answer,
        tempfile.TemporaryFile() as errors,
    ):
        stated = dict(request) if progress.target is None else {**request, "progress": progress.target}
        passed = descriptors if progress.target is None else (*descriptors, progress.target)
        given.write(json.dumps(stated).encode())
        given.seek(0)
        process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-I", "-m", module, str(os.getpid())], env={**(environment or {}), **threads},
            stdin=given, stdout=answer, stderr=errors, pass_fds=passed, cwd=directory,
        )  # fmt: skip
        try:
            overdue, stopped = _wait(process, progress, time.monotonic() + seconds, should_stop)
        finally:
            if process.returncode is None:
                process.kill()
                process.wait()
        if process.returncode == DISK_FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        answer.seek(0)
        errors.seek(max(0, errors.seek(0, os.SEEK_END) - ERRORS_KEPT))
        last = errors.read().decode(errors="replace")
        return Ended(process.returncode, answer.read(MAX_ANSWER + 1), last, overdue, stopped)


def _wait(
    process: subprocess.Popen[bytes], progress: _Progress, until: float, should_stop: Callable[[], bool] | None
) -> tuple[bool, bool]:
    """Deliver progress until a process ends, is overdue or should stop; return whether it is overdue, and whether it should stop."""
    overdue = stopped = False
    while process.poll() is None and not (overdue or stopped):
        overdue = time.monotonic() >= until
        stopped = should_stop is not None and should_stop()
        progress.wait(process, until if should_stop is None else min(until, time.monotonic() + POLL))
    progress.read()
    return overdue, stopped


class _Progress:
    """The pipe over which a contained process sends its progress; absent without a callback."""

    def __init__(self, on_line: Callable[[dict[str, Any]], None] | None) -> None:
        self._on_line = on_line
        self._source: int | None = None
        self._rest = b""
        self.target: int | None = None
        """Descriptor that the process writes to."""

    def __enter__(self) -> _Progress:
        if self._on_line is not None:
            self._source, self.target = os.pipe()
            os.set_blocking(self._source, False)
        return self

    def __exit__(self, *_: object) -> None:
        for descriptor in (self._source, self.target):
            if descriptor is not None:
                os.close(descriptor)

    def wait(self, process: subprocess.Popen[bytes], until: float) -> None:
        """Wait until progress arrives or the process ends, at most until the monotonic time `until`."""
        seconds = max(0.0, until - time.monotonic())
        if self._source is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=seconds)
        elif select.select([self._source], [], [], min(seconds, POLL))[0]:
            self.read()

    def read(self) -> None:
        """Deliver the lines that have arrived, at most one pipe buffer."""
        if self._source is None or self._on_line is None:
            return
        try:
            *lines, self._rest = (self._rest + os.read(self._source, 1 << 16)).split(b"\n")
        except BlockingIOError:
            return
        if len(self._rest) > MAX_LINE:
            self._rest = b""
        for line in lines:
            try:
                stated = json.loads(line)
            except ValueError:  # torn by the end of the process
                continue
            if isinstance(stated, dict):
                self._on_line(stated)


def serve(handle: Callable[[dict[str, Any]], str]) -> int:
    """Run as the contained process: read the request, call `handle`, write its answer or error; return the exit code."""
    die_with_parent(int(sys.argv[1]), how=signal.SIGKILL)
    try:
        try:
            answer, code = handle(json.load(sys.stdin)), DONE
        except Invalid as error:
            answer, code = json.dumps({"code": error.code, **members_of(error)}), REFUSED
        sys.stdout.write(answer)
        sys.stdout.flush()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        os._exit(DISK_FULL)  # without another attempt to write what is buffered, which would change the exit code
    return code


def limit_process(limits: Mapping[int, int]) -> None:
    """Set resource limits for the rest of the process's life; limits that the system lacks are skipped."""
    import resource  # imported here because Windows lacks it, where `pliant solve` reads npz files

    for name, bound in limits.items():
        with suppress(ValueError, OSError):  # macOS has no limit on the address space
            _, hard = resource.getrlimit(name)
            most = bound if hard == resource.RLIM_INFINITY else min(bound, hard)
            resource.setrlimit(name, (most, most))

"""Contained processes that are forked instead of started: their code, limits, descriptors and ends are the real ones.

Starting an interpreter and loading its libraries takes far longer than reading a small file. A process of this module has loaded
them; whenever `run_contained` would start an interpreter, it forks. Whether a fresh interpreter does the same is for the tests that
do not use this: those over HTTP send a file of every format.
"""

from __future__ import annotations

import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, TypedDict, Unpack

import pytest
from pliant.worker.processes import contained
from pliant.worker.processes.containment import die_with_parent

READER, SANDBOX, FILM = (
    "pliant.worker.formats.isolated_reader",
    "pliant.worker.formats.reading.sandbox",
    "pliant.worker.films.contained_process",
)
FREE = 200
"""Descriptors from here on are not used by anyone else."""


class Streams(TypedDict):
    """The keyword arguments of `subprocess.Popen` that `run_contained` gives."""

    env: Mapping[str, str]
    stdin: IO[bytes]
    stdout: IO[bytes]
    stderr: IO[bytes]
    pass_fds: tuple[int, ...]
    cwd: str | None


def standard(given: Streams) -> list[int]:
    return [given["stdin"].fileno(), given["stdout"].fileno(), given["stderr"].fileno()]


def request_of(command: list[str], given: Streams) -> dict[str, Any]:
    """Return what `fork` needs to know; `places` are the descriptors that the process expects."""
    places = [0, 1, 2, *given["pass_fds"]]
    return {"module": command[3], "env": dict(given["env"]), "cwd": given["cwd"] or str(Path.cwd()), "places": places}


class Child:
    """What `run_contained` needs of a `subprocess.Popen`; `parent` is the process that forked it."""

    def __init__(self, pid: int, status: int) -> None:
        self.pid, self.returncode = pid, None  # type: int, int | None
        self._status = status
        os.set_blocking(status, False)

    def poll(self) -> int | None:
        if self.returncode is None:
            try:
                text = os.read(self._status, 100)
            except BlockingIOError:
                return None
            self.returncode = int(text) if text else -signal.SIGKILL
            os.close(self._status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        until = None if timeout is None else time.monotonic() + timeout
        while self.poll() is None:
            if until is not None and time.monotonic() >= until:
                raise subprocess.TimeoutExpired("forked", timeout or 0)
            time.sleep(0.002)
        assert self.returncode is not None
        return self.returncode

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)


class Forks:
    """The process that has loaded everything, seen from the tests."""

    def __init__(self) -> None:
        self._one_at_a_time = threading.Lock()
        self._ours, theirs = socket.socketpair()
        with theirs:
            command = [sys.executable, "-I", __file__, str(theirs.fileno()), str(os.getpid())]
            threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
            self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()], env=threads)

    def start(self, command: list[str], **given: Unpack[Streams]) -> Child:
        """Take the arguments of `subprocess.Popen` that `run_contained` gives."""
        status, theirs = os.pipe()
        request = request_of(command, given)
        descriptors = [*standard(given), *given["pass_fds"], theirs]
        with self._one_at_a_time:
            socket.send_fds(self._ours, [json.dumps(request).encode()], descriptors)
            pid = int(self._ours.recv(100))
        os.close(theirs)
        return Child(pid, status)

    def close(self) -> None:
        self._ours.close()
        self._process.wait(20)


@contextmanager
def forks() -> Iterator[Forks]:
    made = Forks()
    try:
        yield made
    finally:
        made.close()


def use(made: Forks, patch: pytest.MonkeyPatch) -> None:
    """Make `run_contained` fork."""
    patch.setattr(contained, "subprocess", SimpleNamespace(Popen=made.start, TimeoutExpired=subprocess.TimeoutExpired))


def served(control: socket.socket) -> None:
    """Fork for every request until the tests end."""
    from pliant.worker.formats.reading.parsers import PARSERS

    for module in (READER, SANDBOX, FILM, "pliant.tracking.region", "pliant.tracking.track", "numpy.ma"):
        import_module(module)
    for parser in PARSERS.values():
        parser.load()
    while True:
        text, received, _, _ = socket.recv_fds(control, 1 << 16, 16)
        if not text:
            return
        request, (*given, status) = json.loads(text), received
        pid = fork(request, given, close=[control.fileno(), status])
        control.send(str(pid).encode())
        for descriptor in given:
            os.close(descriptor)
        os.write(status, str(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])).encode())
        os.close(status)


def fork(request: Mapping[str, Any], given: list[int], *, close: list[int]) -> int:
    parent = os.getpid()
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        for descriptor in close:
            os.close(descriptor)
        moved = [fcntl.fcntl(descriptor, fcntl.F_DUPFD, FREE) for descriptor in given]
        for descriptor in given:
            os.close(descriptor)
        for descriptor, place in zip(moved, request["places"], strict=True):
            os.dup2(descriptor, place)
            os.close(descriptor)
        # Not closed with their files: those of a forked reader would close the descriptors of its own sandbox.
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        os.environ.clear()
        os.environ.update(request["env"])
        os.chdir(request["cwd"])
        sys.argv = [request["module"], str(parent)]
        contained.subprocess = SimpleNamespace(  # type: ignore[assignment]
            Popen=forked_by_a_fork, TimeoutExpired=subprocess.TimeoutExpired
        )
        code = sys.modules[request["module"]].main()
        sys.stdout.flush()
    except BaseException:  # noqa: BLE001 - as an interpreter does
        code = 1
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


class Grandchild:
    """The sandbox that a forked reader starts: a fork of the reader."""

    def __init__(self, pid: int) -> None:
        self.pid, self.returncode = pid, None  # type: int, int | None

    def poll(self) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    wait = Child.wait

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)


def forked_by_a_fork(command: list[str], **given: Unpack[Streams]) -> Grandchild:
    request, copies = request_of(command, given), [os.dup(each) for each in (*standard(given), *given["pass_fds"])]
    pid = fork(request, copies, close=[])
    for descriptor in copies:
        os.close(descriptor)
    return Grandchild(pid)


if __name__ == "__main__":
    die_with_parent(int(sys.argv[2]), how=signal.SIGKILL)
    with socket.socket(fileno=int(sys.argv[1])) as control:
        served(control)

"""The supervisor: start processes, restart those that end, stop them all on SIGTERM or Ctrl-C.

It only manages processes and uses neither Redis nor HTTP, so an unavailable service cannot block it.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import FrameType

from pliant.worker.processes.containment import NUMERICAL_THREADS, die_with_parent
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings

logger = logging.getLogger(__name__)

FIRST_PAUSE, LONGEST_PAUSE = 0.2, 15.0
"""Seconds before an ended process is restarted; doubled each time it ends early."""

STABLE_AFTER = 20.0
"""Seconds after which a process counts as started successfully."""

POLL = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Child:
    """A process to keep running."""

    name: str
    argv: list[str]
    env: Mapping[str, str] = field(default_factory=dict)
    """Environment variables, in addition to the supervisor's own."""

    descriptors: tuple[int, ...] = ()
    """File descriptors it inherits."""

    ready: Callable[[subprocess.Popen[bytes]], None] | None = None
    """Returns once the process is ready; at start, the next process waits for it."""

    log_tail: Callable[[], str] | None = None
    """Returns the last lines of its log, for the message that it ended."""

    cause: Callable[[], str] | None = None
    """Returns a sentence on why it may have ended, for the same message; empty if there is nothing to tell."""

    foundation: bool = False
    """Stop this process only after all others, which depend on it."""

    grace: float = 10.0
    """Seconds between SIGTERM and SIGKILL."""


@dataclass(slots=True)
class _Running:
    child: Child
    process: subprocess.Popen[bytes] | None = None
    began: float = 0.0
    pause: float = FIRST_PAUSE
    restart_at: float = 0.0


class _StopRequested(BaseException):
    """A signal arrived while the children were being started.

    The signal handler raises it only during a `ready`: an exception in the middle of starting a process would lose that process, and
    Python ignores those of a handler that runs in a hook of `fork`.
    """


class Supervisor:
    """Keeps children running until it is stopped. Use it from the main thread: its children end with that thread."""

    def __init__(self, children: list[Child]) -> None:
        self._running = [_Running(child) for child in children]
        self._waiting = False
        self._stopping = False
        self._forced = False

    def start(self) -> None:
        """Start all children, in order, waiting for each one's `ready`; if one fails, stop the others and raise."""
        try:
            for each in self._running:
                self._end_if_stopping()
                self._launch(each)
                if each.child.ready is not None and each.process is not None:
                    self._wait(each.child.ready, each.process)
            self._end_if_stopping()
        except BaseException:
            self.stop()
            raise

    def run(self, *, on_started: Callable[[], None] | None = None) -> None:
        """Start the children and keep them running until SIGTERM or Ctrl-C; then stop them. A second signal stops waiting."""
        handlers = {number: signal.signal(number, self._on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            self.start()
            if on_started is not None:
                on_started()
            while not self._stopping:
                self.look()
                time.sleep(POLL)
        except _StopRequested:
            logger.info("stopped while starting")
        finally:
            self.stop()
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def look(self) -> None:
        """Restart ended children, after a pause that grows while they keep ending early."""
        now = time.monotonic()
        for each in self._running:
            if each.process is None:
                if now >= each.restart_at:
                    self._launch_again(each, now)
            elif (code := each.process.poll()) is not None:
                each.pause = FIRST_PAUSE if now - each.began > STABLE_AFTER else min(2 * each.pause, LONGEST_PAUSE)
                each.process, each.restart_at = None, now + each.pause
                last = "" if each.child.log_tail is None else each.child.log_tail()
                why = f". Its log ends with: {last}" if last else ""
                cause = "" if each.child.cause is None else each.child.cause()
                told = f"{each.child.name} ended with code {code}{why}. {cause}".rstrip()
                logger.warning("%s Starting it again in %.1f s", told, each.pause)

    def stop(self) -> None:
        """Stop the children, foundations last; kill each one that outlives its grace period."""
        for foundation in (False, True):
            group = [each for each in self._running if each.child.foundation is foundation and each.process is not None]
            for each in reversed(group):
                _signal(each, signal.SIGTERM)
            began = time.monotonic()
            while alive := [each for each in group if each.process is not None and each.process.poll() is None]:
                for each in alive:
                    if time.monotonic() > began + each.child.grace or (self._forced and not foundation):
                        logger.warning("%s does not stop; killing it", each.child.name)
                        _signal(each, signal.SIGKILL)
                time.sleep(POLL)
            for each in group:
                each.process = None

    def pids(self) -> dict[str, int]:
        """Return the process id of every running child, by name."""
        return {each.child.name: each.process.pid for each in self._running if each.process is not None}

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002
        self._forced = self._stopping
        self._stopping = True
        if self._waiting:
            self._waiting = False
            raise _StopRequested

    def _wait(self, ready: Callable[[subprocess.Popen[bytes]], None], process: subprocess.Popen[bytes]) -> None:
        self._waiting = True
        try:
            self._end_if_stopping()  # the signal may have arrived before
            ready(process)
        finally:
            self._waiting = False

    def _end_if_stopping(self) -> None:
        if self._stopping:
            raise _StopRequested

    def _launch_again(self, each: _Running, now: float) -> None:
        try:
            self._launch(each)
        except OSError as error:  # out of processes, memory or descriptors: the other children keep running
            each.pause = min(2 * each.pause, LONGEST_PAUSE)
            each.restart_at = now + each.pause
            logger.warning("%s cannot be started: %s. Trying again in %.1f s", each.child.name, error, each.pause)

    def _launch(self, each: _Running) -> None:
        child, parent = each.child, os.getpid()
        each.process = subprocess.Popen(  # noqa: S603
            child.argv,
            env={**os.environ, **child.env},
            pass_fds=child.descriptors,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C reaches the supervisor only, which stops them in order
            preexec_fn=lambda: die_with_parent(parent, how=signal.SIGTERM),
        )
        each.began = time.monotonic()


def valkey_child(valkey: Valkey) -> Child:
    """Return the embedded Valkey of a claimed data directory as a child."""
    return Child(
        name="valkey",
        argv=valkey.argv,
        descriptors=(valkey.server_lock,),
        ready=valkey.wait,
        log_tail=valkey.log_tail,
        cause=valkey.cause,
        foundation=True,
        grace=15.0,
    )


def worker_children(settings: Settings) -> list[Child]:
    """Return the workers and the reconciler as children."""
    threads = dict.fromkeys(NUMERICAL_THREADS, "1")
    env = {**settings.to_environment(), **threads}
    command = [sys.executable, "-m", "pliant.worker"]
    grace = settings.stop_grace + 5
    workers = [
        Child(name=f"worker-{number + 1}", argv=[*command, "work"], env=env, grace=grace)
        for number in range(settings.workers)
    ]
    return [*workers, Child(name="reconciler", argv=[*command, "reconcile"], env=env)]


def _signal(each: _Running, number: signal.Signals) -> None:
    if each.process is not None and each.process.poll() is None:
        each.process.send_signal(number)

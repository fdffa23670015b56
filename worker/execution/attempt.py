"""One attempt at a job, in the job process: claim the job, run it, publish the result or the failure.

Numerical modules are imported inside functions, so that processes that only read records do not load them; a worker
loads them before it forks.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import resource
import shutil
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pliant.schemas.job import Problem, Progress, Status
from pliant.worker import tracing
from pliant.worker.errors import ForeignStore, Interrupted, StaleAttempt, StoreUnavailable, UnknownJob
from pliant.worker.execution.failures import problem_of, timed_out
from pliant.worker.execution.monitor import RetryDeadline
from pliant.worker.execution.progress import Reporter
from pliant.worker.execution.workdir import OUTPUT, working_directory
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.foreign_store import check_blob_store
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Stored, dated
from pliant.worker.settings import Settings

if TYPE_CHECKING:
    from pliant.worker.jobs.finished import Finished

logger = logging.getLogger(__name__)

PROGRESS_INTERVAL = 0.5
"""Minimum seconds between two writes of the progress."""

STATUS_INTERVAL = 0.25
"""Minimum seconds between two reads of the job's status."""

PAUSE_AFTER_SILENCE = 4.0
"""Pause after a call that the store did not answer, in durations of the call: a store that hangs slows a job down by at most a quarter."""

RETRY_SECONDS = 60.0
"""Seconds for which calls to an unavailable store are retried when claiming the job, reading its inputs and publishing its result."""


def run(id: str, attempt_id: str, *, settings: Settings, worker: str) -> None:
    """Run one delivered attempt; return when its outcome is recorded, or when the job belongs to another attempt."""
    jobs, now = Jobs.open(settings), datetime.now(UTC)
    claim = partial(lifecycle.claim, attempt_id=attempt_id, worker=worker, now=now)
    try:
        stored = RetryDeadline(RETRY_SECONDS).retry(lambda: jobs.records.update(id, claim))
    except (StaleAttempt, UnknownJob) as error:
        logger.info("job %s: delivery %s dropped: %s", id, attempt_id, error, extra={"job": id})
        return
    attempt = Attempt(jobs=jobs, id=id, attempt_id=attempt_id, deadline=_deadline(settings))
    about = {"job": id, "attempt": stored.job.attempt, "worker": worker}
    logger.info("job %s: attempt %d began", id, stored.job.attempt, extra=about)
    tracing.configure(settings.tracing, service="pliant-worker")
    try:
        with tracing.span("attempt", parent=stored.trace, job=id, attempt=stored.job.attempt, worker=worker):
            if stored.job.started_at is not None:
                tracing.past("queued", begin=stored.job.created_at, end=stored.job.started_at)
            status = _conclude(attempt, stored, worker=worker, settings=settings)
        why, code = ("", {}) if attempt.code is None else (f" ({attempt.code})", {"code": attempt.code})
        about |= {"outcome": status, **code}
        logger.info("job %s: attempt %d ended: %s%s", id, stored.job.attempt, status, why, extra=about)
    finally:
        tracing.finish()


def _conclude(attempt: Attempt, stored: Stored, *, worker: str, settings: Settings) -> str:
    """Run a claimed attempt with redirected output and a memory limit, record its outcome and return it as one word."""
    directory = working_directory(settings, attempt.attempt_id)
    attempt.log(f"Attempt {stored.job.attempt} began on worker {worker}.")
    with contextlib.ExitStack() as stack:
        try:
            try:
                directory.mkdir(parents=True, exist_ok=True)
                stack.enter_context(_own_output(directory / OUTPUT))
            except OSError as error:
                return attempt.conclude(attempt.failed(error))
            with limited_memory(settings.memory_limit):
                end = work(attempt, stored, directory)
            if isinstance(end, Problem):
                attempt.discard(directory)
            return attempt.conclude(end)
        except (StaleAttempt, UnknownJob) as error:
            logger.info(
                "job %s: attempt %s ended: %s", attempt.id, attempt.attempt_id, error, extra={"job": attempt.id}
            )
            return "stale"
        finally:
            attempt.stages.end()


@dataclass(slots=True, kw_only=True)
class Attempt:
    """One attempt at a job, in the job process: writes progress and outcome, reads the job's status."""

    jobs: Jobs
    id: str
    attempt_id: str
    deadline: float
    """Monotonic time at which the time limit is reached."""
    unwanted: bool = False
    """Whether the job was cancelled, timed out, or belongs to another attempt."""
    code: str | None = None
    """Code of the error that the job has failed with."""
    warnings: Sequence[str] = ()
    """Warnings about a film, known before its job is solved; they may explain why it fails."""
    _parent: int = field(default_factory=os.getppid)
    _next_report: float = 0.0
    _stage: str = ""
    stages: tracing.Stages = field(default_factory=tracing.Stages)
    """Trace spans of the stages."""
    _next_look: float = 0.0
    _silent_until: float = 0.0
    """Monotonic time before which the store is not asked again, since it did not answer."""
    _lines: list[str] = field(default_factory=list)
    """Log lines that are not written yet."""
    _log_lock: threading.Lock = field(default_factory=threading.Lock)
    """Guards `_lines`, because a separate thread repeats the progress."""

    def report(self, progress: Progress) -> None:
        """Write the progress, at most every `PROGRESS_INTERVAL` seconds within a stage. An unavailable store is ignored."""
        self.stages.enter(progress.stage)
        now = time.monotonic()
        if now < self._silent_until or (now < self._next_report and progress.stage == self._stage):
            return
        self._next_report, self._stage = now + PROGRESS_INTERVAL, progress.stage
        try:
            self.jobs.records.update(
                self.id, lambda held: lifecycle.report(held, attempt_id=self.attempt_id, progress=progress)
            )
            self._flush()
        except (StaleAttempt, UnknownJob):
            self.unwanted = True
        except StoreUnavailable as error:
            self._pause_since(now)
            logger.warning("job %s: progress not written: %s", self.id, error, extra={"job": self.id})

    def should_stop(self) -> bool:
        """Return whether the attempt should stop; reads the record at most every `STATUS_INTERVAL` seconds."""
        now = time.monotonic()
        if not self.unwanted and now >= self._next_look:
            self._next_look = now + STATUS_INTERVAL
            if os.getppid() != self._parent:
                os._exit(1)  # orphaned, where the kernel does not kill orphans; the reconciler requeues the job
            self.unwanted = now >= self.deadline or self._status(now) is not Status.RUNNING
        return self.unwanted

    def log(self, text: str) -> None:
        """Append text to the job's log; it is written with the next progress."""
        with self._log_lock:
            self._lines += dated(text)

    def failed(self, error: Exception) -> Problem:
        """Return the problem that an error ends the job with, and log it, with a traceback if it is unexpected."""
        problem = problem_of(error, memory_limit=self.jobs.settings.memory_limit)
        self.log(f"Failed: {problem.detail}")
        if problem.code in ("internal_error", "storage_failed", "store_unavailable", "out_of_memory"):
            self.log("".join(traceback.format_exception(error)))
        return problem

    def discard(self, directory: Path) -> None:
        """Remove the files of a failed attempt, except its output: on a full disk, the store of records needs their space."""
        for path in directory.iterdir():
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != OUTPUT:
                path.unlink(missing_ok=True)
        with contextlib.suppress(StoreUnavailable):
            self.jobs.blobs.delete(self.prefix)

    def conclude(self, end: Finished | Problem | None) -> str:
        """Record the outcome: the result, the problem, or None for a stop on request. Return the job's status.

        Raises
        ------
        StaleAttempt
            The job belongs to another attempt.
        StoreUnavailable
            The store has not answered for `RETRY_SECONDS` seconds.
        """
        settings, now = self.jobs.settings, datetime.now(UTC)

        def change(held: Stored) -> Stored:
            if end is None:
                return lifecycle.stop(held, attempt_id=self.attempt_id, now=now, retention=settings.retention)
            if isinstance(end, Problem):
                return lifecycle.fail(
                    held, attempt_id=self.attempt_id, problem=end, now=now, retention=settings.retention,
                    warnings=self.warnings,
                )  # fmt: skip
            return lifecycle.succeed(
                held, end, attempt_id=self.attempt_id, prefix=self.prefix, now=now, retention=settings.retention
            )

        deadline = RetryDeadline(RETRY_SECONDS)
        with contextlib.suppress(StoreUnavailable):
            deadline.retry(self._flush)
        kept = deadline.retry(lambda: self.jobs.records.update(self.id, change))
        if kept.prefix is None:
            self.jobs.blobs.delete(self.prefix)
        self.code = None if kept.job.error is None else kept.job.error.code
        return kept.job.status.value

    def store(self, finished: Finished, results: Path) -> None:
        """Store the result files, retrying while the blob store is unavailable.

        Raises
        ------
        Interrupted
            The attempt should stop.
        StoreUnavailable
            The blob store has not answered for `RETRY_SECONDS` seconds.
        """
        for artifact in finished.artifacts:
            key, file = f"{self.prefix}{artifact.name}", results / artifact.name
            put = partial(self.jobs.blobs.put, key, file, media_type=artifact.media_type)
            self.wait_for_store(put)

    def wait_for_store(self, call: Callable[[], object]) -> None:
        """Retry a call until the store answers, for at most `RETRY_SECONDS` seconds.

        Raises
        ------
        Interrupted
            The attempt should stop.
        StoreUnavailable
            The store has not answered.
        """

        def wanted() -> None:
            if self.should_stop():
                raise Interrupted
            call()

        RetryDeadline(RETRY_SECONDS).retry(wanted)

    @property
    def prefix(self) -> str:
        """Blob prefix of this attempt's artifacts, which are published when the job's record names the prefix."""
        return f"jobs/{self.id}/{self.attempt_id}/artifacts/"

    def _status(self, now: float) -> Status | None:
        if now < self._silent_until:
            return Status.RUNNING
        try:
            return self.jobs.records.look(self.id, self.attempt_id)
        except StoreUnavailable:
            self._pause_since(now)
            return Status.RUNNING

    def _pause_since(self, began: float) -> None:
        now = time.monotonic()
        self._silent_until = now + PAUSE_AFTER_SILENCE * (now - began)

    def _flush(self) -> None:
        with self._log_lock:
            self.jobs.records.append_log(self.id, self._lines)
            self._lines.clear()


def work(
    attempt: Attempt, stored: Stored, directory: Path, *, reconstruct: Callable[..., Finished] | None = None
) -> Finished | Problem | None:
    """Run the job; return its result, the problem that it failed with, or None after a stop on request.

    Tracebacks of unexpected errors are logged. `reconstruct` replaces `pliant.worker.execution.pipeline.reconstruct` in tests.

    Raises
    ------
    ForeignStore
        Neither the inputs of this job nor those of others are in the blob store.
    StaleAttempt, UnknownJob
        The job belongs to another attempt, or was deleted.
    """
    try:
        from pliant.solver import threads_limited

        file = directory / "inputs.npz"
        with _repeating(attempt, "loading", 0.0):
            try:
                attempt.wait_for_store(lambda: attempt.jobs.blobs.fetch(stored.inputs, file))
            except FileNotFoundError:
                attempt.wait_for_store(lambda: check_blob_store(attempt.jobs))
                raise
        results = directory / "artifacts"
        with threads_limited(attempt.jobs.settings.threads_per_job):
            if stored.result is not None:
                finished = _write_further(attempt, stored, file, results)
            else:
                finished = _reconstruct(attempt, stored, file, results, reconstruct=reconstruct)
        with _repeating(attempt, "exporting", 1.0):
            attempt.store(finished, results)
    except Interrupted:
        late = time.monotonic() >= attempt.deadline
        attempt.log("Stopped: the time limit was reached." if late else "Stopped on request.")
        return timed_out(attempt.jobs.settings.time_limit) if late else None
    except (StaleAttempt, UnknownJob, ForeignStore):
        raise
    except Exception as error:  # noqa: BLE001  every failure must end the job with a problem
        return attempt.failed(error)
    ended = " ".join(sentence for sentence in (finished.trust_sentence, finished.sentence) if sentence is not None)
    attempt.log(f"{ended} {_listed([each.name for each in finished.artifacts])}")
    return finished


@contextlib.contextmanager
def _repeating(attempt: Attempt, part: str, done: float) -> Iterator[None]:
    """Repeat the progress of a part that reports none itself, such as fetching, reading or storing a gigabyte."""
    reporter = Reporter(attempt.report)
    reporter.part(part, done)
    with reporter.ticking():
        yield


def _reconstruct(
    attempt: Attempt, stored: Stored, inputs: Path, results: Path, *, reconstruct: Callable[..., Finished] | None
) -> Finished:
    """Solve stored tracks, or track and solve a stored film."""
    from pliant.worker.execution import pipeline
    from pliant.worker.execution.film import reconstruct_film
    from pliant.worker.films.bounds import FilmBounds
    from pliant.worker.films.sources import is_source, open_source
    from pliant.worker.formats import load_inputs
    from pliant.worker.processes.memory import memory_for_a_job

    options = stored.job.options
    if not is_source(inputs):
        with _repeating(attempt, "loading", 0.0):
            read = load_inputs(inputs)
        return (reconstruct or pipeline.reconstruct)(
            read, options, results, name=stored.job.name, on_progress=attempt.report, should_stop=attempt.should_stop,
        )  # fmt: skip
    settings, scratch = attempt.jobs.settings, inputs.with_name("film")
    source = open_source(inputs, inputs.with_name("source"))
    scratch.mkdir()

    def on_warnings(warnings: Sequence[str]) -> None:
        attempt.warnings = warnings

    return reconstruct_film(
        source, options, results, scratch=scratch, name=stored.job.name, threads=settings.threads_per_job, bounds=FilmBounds.of(settings),
        memory=memory_for_a_job(settings), on_progress=attempt.report, on_warnings=on_warnings,
        should_stop=attempt.should_stop,
    )  # fmt: skip


def _write_further(attempt: Attempt, stored: Stored, inputs: Path, results: Path) -> Finished:
    from pliant.worker.execution.further_outputs import write_further

    file, key = inputs.with_name("result.npz"), stored.result
    assert key is not None
    attempt.wait_for_store(lambda: attempt.jobs.blobs.fetch(key, file))
    return write_further(inputs, file, stored.job, results, on_progress=attempt.report, should_stop=attempt.should_stop)


def _listed(names: Sequence[str]) -> str:
    return "Wrote " + ", ".join(names) + "."


def _deadline(settings: Settings) -> float:
    return time.monotonic() + settings.time_limit if settings.time_limit > 0 else float("inf")


@contextlib.contextmanager
def limited_memory(limit: int) -> Iterator[None]:
    """Limit the address space, so that too large an array raises MemoryError instead of ending the process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    allowed = limit or soft
    with contextlib.suppress(ValueError, OSError):  # macOS has no limit on the address space
        resource.setrlimit(
            resource.RLIMIT_AS, (allowed if hard == resource.RLIM_INFINITY else min(allowed, hard), hard)
        )
    try:
        yield
    finally:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextlib.contextmanager
def _own_output(file: Path) -> Iterator[None]:
    """Redirect standard output and error, native code's included, to the attempt's file, which also receives crash traces."""
    with file.open("wb") as output:
        kept = os.dup(1), os.dup(2)
        for descriptor in (1, 2):
            os.dup2(output.fileno(), descriptor)
        faulthandler.enable(file=output)
        try:
            yield
        finally:
            faulthandler.disable()
            for old, descriptor in zip(kept, (1, 2), strict=True):
                os.dup2(old, descriptor)
                os.close(old)

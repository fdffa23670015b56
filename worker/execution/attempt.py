"""What a job process does with one delivery: claim the job, run it, publish the result or the reason why there is none.

What computes is imported inside the functions, so that who only asks after jobs does not load it; a worker loads it before
it forks.
"""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import os
import resource
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from pliant.schemas.job import Problem, Progress, Status
from pliant.worker.errors import Interrupted, StaleAttempt, StoreUnavailable, UnknownJob
from pliant.worker.execution.failures import problem_of, timed_out
from pliant.worker.execution.monitor import Patience
from pliant.worker.execution.workdir import OUTPUT, working_directory
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import Stored
from pliant.worker.settings import Settings

if TYPE_CHECKING:
    from pliant.worker.execution.pipeline import Finished

logger = logging.getLogger(__name__)

TELL_EVERY = 0.5
"""Least seconds between two progress writes."""

ASK_EVERY = 0.25
"""Least seconds between two looks at whether the job is still wanted."""

PATIENCE = 60.0
"""Seconds that a job waits for a store that does not answer, before it computes and once it has its result."""


def run(id: str, attempt_id: str, *, settings: Settings, worker: str) -> None:
    """Work on one delivered attempt. Returns when the record has the last word, or belongs to somebody else."""
    jobs = Jobs.open(settings)
    try:
        stored = jobs.records.update(
            id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker=worker, now=datetime.now(UTC))
        )
    except (StaleAttempt, UnknownJob) as error:
        logger.info("delivery %s dropped: %s", attempt_id, error)
        return
    attempt = Attempt(jobs=jobs, id=id, attempt_id=attempt_id, deadline=_deadline(settings))
    directory = working_directory(settings, attempt_id)
    directory.mkdir(parents=True, exist_ok=True)
    attempt.log(f"Attempt {stored.job.attempt} began on worker {worker}.")
    with _own_output(directory / OUTPUT):
        try:
            with _limited_memory(settings.memory_limit):
                end = work(attempt, stored, directory)
            attempt.conclude(end)
        except (StaleAttempt, UnknownJob) as error:
            logger.info("attempt %s ended: %s", attempt_id, error)


@dataclass(slots=True, kw_only=True)
class Attempt:
    """One try at a job, seen from inside: what it tells the record, and what the record tells it."""

    jobs: Jobs
    id: str
    attempt_id: str
    deadline: float
    """Monotonic time after which the job has taken too long."""
    unwanted: bool = False
    """True once the job was cancelled, has taken too long, or belongs to another attempt."""
    _parent: int = field(default_factory=os.getppid)
    _next_tell: float = 0.0
    _next_ask: float = 0.0
    _lines: list[str] = field(default_factory=list)

    def tell(self, progress: Progress) -> None:
        """Write the progress, at most twice a second; a store that does not answer is no reason to stop."""
        now = time.monotonic()
        if now < self._next_tell:
            return
        self._next_tell = now + TELL_EVERY
        try:
            self.jobs.records.update(
                self.id, lambda held: lifecycle.report(held, attempt_id=self.attempt_id, progress=progress)
            )
            self._flush()
        except (StaleAttempt, UnknownJob):
            self.unwanted = True
        except StoreUnavailable as error:
            logger.warning("progress not written: %s", error)

    def should_stop(self) -> bool:
        """Tell the solver whether the job is unwanted; asks the record at most four times a second."""
        now = time.monotonic()
        if not self.unwanted and now >= self._next_ask:
            self._next_ask = now + ASK_EVERY
            if os.getppid() != self._parent:
                os._exit(1)  # where the kernel does not end an orphan; the reconciler gives its job to another
            self.unwanted = now >= self.deadline or self._status() is not Status.RUNNING
        return self.unwanted

    def log(self, text: str) -> None:
        """Add to the job's log; written with the next progress."""
        moment = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        self._lines += [f"{moment} {line}" for line in text.splitlines()]

    def conclude(self, end: Finished | Problem | None) -> None:
        """Give the record its last word: the result, the reason why there is none, or None for a stop on request.

        Raises
        ------
        StaleAttempt
            The job belongs to another attempt.
        StoreUnavailable
            The store does not answer for a minute.
        """
        settings, now = self.jobs.settings, datetime.now(UTC)

        def change(held: Stored) -> Stored:
            if end is None:
                return lifecycle.stop(held, attempt_id=self.attempt_id, now=now, retention=settings.retention)
            if isinstance(end, Problem):
                return lifecycle.fail(
                    held, attempt_id=self.attempt_id, problem=end, now=now, retention=settings.retention
                )
            return lifecycle.succeed(
                held, attempt_id=self.attempt_id, prefix=self.prefix, artifacts=end.artifacts, metrics=end.metrics,
                outcome=end.outcome, sentence=end.sentence, warnings=end.warnings, now=now, retention=settings.retention,
                interpretation=end.interpretation,
                verdict=end.verdict, verdict_reasons=end.verdict_reasons, trust_sentence=end.trust_sentence,
            )  # fmt: skip

        with contextlib.suppress(StoreUnavailable):
            self._flush()
        kept = Patience(PATIENCE).ask(lambda: self.jobs.records.update(self.id, change))
        if kept.prefix is None:
            self.jobs.blobs.delete(self.prefix)

    def store(self, finished: Finished, results: Path) -> None:
        """Store the result files, waiting for a blob store that does not answer.

        Raises
        ------
        Interrupted
            The job is no longer wanted.
        StoreUnavailable
            The blob store has not answered for `PATIENCE` seconds.
        """
        for artifact in finished.artifacts:
            key, file = f"{self.prefix}{artifact.name}", results / artifact.name
            self.wait_for_store(lambda key=key, file=file: self.jobs.blobs.put(key, file))  # type: ignore[misc]

    def wait_for_store(self, call: Callable[[], object]) -> None:
        """Call until the store answers, at most for `PATIENCE` seconds.

        Raises
        ------
        Interrupted
            The job is no longer wanted.
        StoreUnavailable
            The store has not answered.
        """

        def wanted() -> None:
            if self.should_stop():
                raise Interrupted
            call()

        Patience(PATIENCE).ask(wanted)

    @property
    def prefix(self) -> str:
        """Where this attempt's artifacts lie; only the record makes them the job's."""
        return f"jobs/{self.id}/{self.attempt_id}/artifacts/"

    def _status(self) -> Status | None:
        try:
            return self.jobs.records.look(self.id, self.attempt_id)
        except StoreUnavailable:
            return Status.RUNNING

    def _flush(self) -> None:
        lines, self._lines = self._lines, []
        self.jobs.records.append_log(self.id, lines)


def work(
    attempt: Attempt, stored: Stored, directory: Path, *, reconstruct: Callable[..., Finished] | None = None
) -> Finished | Problem | None:
    """Run the job; every exception becomes the problem it is, its traceback goes into the log.

    `reconstruct` replaces `pliant.worker.execution.pipeline.reconstruct`, in tests.
    """
    try:
        from pliant.solver import threads_limited

        file = directory / "inputs.npz"
        attempt.wait_for_store(lambda: attempt.jobs.blobs.fetch(stored.inputs, file))
        results = directory / "artifacts"
        with threads_limited(attempt.jobs.settings.threads_per_job):
            if stored.result is not None:
                finished = _write_further(attempt, stored, file, results)
            else:
                finished = _reconstruct(attempt, stored, file, results, reconstruct=reconstruct)
        attempt.store(finished, results)
    except Interrupted:
        late = time.monotonic() >= attempt.deadline
        attempt.log("Stopped: it took too long." if late else "Stopped on request.")
        return timed_out(attempt.jobs.settings.time_limit) if late else None
    except (StaleAttempt, UnknownJob):
        raise
    except Exception as error:  # noqa: BLE001  whatever it is, the user is owed an answer and the log the traceback
        problem = problem_of(error, memory_limit=attempt.jobs.settings.memory_limit)
        attempt.log(f"Failed: {problem.detail}")
        if problem.code in ("internal_error", "storage_failed", "store_unavailable", "out_of_memory"):
            attempt.log("".join(traceback.format_exception(error)))
        return problem
    ended = " ".join(sentence for sentence in (finished.trust_sentence, finished.sentence) if sentence is not None)
    attempt.log(f"{ended} {_listed([each.name for each in finished.artifacts])}")
    return finished


def _reconstruct(
    attempt: Attempt, stored: Stored, inputs: Path, results: Path, *, reconstruct: Callable[..., Finished] | None
) -> Finished:
    """Solve stored tracks, or track and solve a stored film."""
    from pliant.worker.execution import pipeline
    from pliant.worker.execution.film import reconstruct_film
    from pliant.worker.films.sources import FilmBounds, is_source, open_source
    from pliant.worker.formats import load_inputs

    options = stored.job.options
    if not is_source(inputs):
        return (reconstruct or pipeline.reconstruct)(
            load_inputs(inputs), options, results, on_progress=attempt.tell, should_stop=attempt.should_stop
        )
    settings, scratch = attempt.jobs.settings, inputs.with_name("film")
    memory = min(FilmBounds().memory, settings.memory_limit or FilmBounds().memory)
    source = open_source(inputs, inputs.with_name("source"))
    scratch.mkdir()
    return reconstruct_film(
        source, options, results, scratch=scratch, threads=settings.threads_per_job, bounds=FilmBounds(memory=memory),
        on_progress=attempt.tell, should_stop=attempt.should_stop,
    )  # fmt: skip


def _write_further(attempt: Attempt, stored: Stored, inputs: Path, results: Path) -> Finished:
    """Write further files of a stored result."""
    from pliant.worker.execution.further_outputs import write_further

    file, key = inputs.with_name("result.npz"), stored.result
    assert key is not None
    attempt.wait_for_store(lambda: attempt.jobs.blobs.fetch(key, file))
    return write_further(inputs, file, stored.job, results, on_progress=attempt.tell, should_stop=attempt.should_stop)


def _listed(names: Sequence[str]) -> str:
    return "Wrote " + ", ".join(names) + "."


def _deadline(settings: Settings) -> float:
    return time.monotonic() + settings.time_limit if settings.time_limit > 0 else float("inf")


@contextlib.contextmanager
def _limited_memory(limit: int) -> Iterator[None]:
    """Bound the address space, so that too large an array is a MemoryError instead of a kill."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (limit or soft, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextlib.contextmanager
def _own_output(file: Path) -> Iterator[None]:
    """Send standard output and error, native code's too, into the attempt's own file; a crash leaves its stack there."""
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

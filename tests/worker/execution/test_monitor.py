"""Supervision of an attempt on a simulated clock, and the outcome of a job process that recorded none."""

from __future__ import annotations

import dataclasses
import itertools
import re
import signal
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
import redis
from pliant.schemas.job import Interpretation, Problem, Progress, Status
from pliant.schemas.options import Options
from pliant.solver import InvalidInput
from pliant.worker.errors import StoreUnavailable
from pliant.worker.execution.failures import how_it_ended, out_of_memory, problem_of, timed_out
from pliant.worker.execution.monitor import Reason, RetryDeadline, Watch, finalize
from pliant.worker.execution.progress import FILM_SHARES, SHARES, Reporter
from pliant.worker.execution.rq_worker import Delivery
from pliant.worker.execution.workdir import OUTPUT, working_directory
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.processes.containment import OomKills
from pliant.worker.records import Change, Records, Stored
from pliant.worker.store.queue import FUNCTION

NOW = datetime(2030, 1, 1, tzinfo=UTC)
KILLED = int(signal.SIGKILL)
"""A wait status is the signal's number in the low bits, or the exit code in the next byte."""


@pytest.fixture
def running(jobs: Jobs, inputs_file: Path, interpretation: Interpretation) -> Callable[..., Watch]:
    """A claimed job under supervision, with settings and a clock set by the test."""

    def make(time: list[float] | None = None, options: Options | None = None, **settings: object) -> Watch:
        id = jobs.submit(inputs_file, Submission(options=options or Options()), interpretation=interpretation)[0].id
        attempt_id = jobs.records.get(id).attempt_id
        jobs.records.update(id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="me", now=NOW))
        clock = time if time is not None else [0.0]
        changed = dataclasses.replace(jobs.settings, cancel_grace=3.0, **settings)  # type: ignore[arg-type]
        return Watch(changed, jobs.records, id=id, attempt_id=attempt_id, worker="me", clock=lambda: clock[0])

    return make


def test_a_cancelled_attempt_is_killed_after_its_grace(jobs: Jobs, running: Callable[..., Watch]) -> None:
    time = [0.0]
    watch = running(time)
    assert watch.must_end(stop_by=None) is None
    jobs.cancel(watch.id)
    found = []
    for time[0] in (0.5, 1.5, 4.0, 4.5):
        found.append(watch.must_end(stop_by=None))
    assert found == [None, None, None, Reason.CANCELLED], "noticed at the beat of 1.5 s, killed 3 s later"
    after = finalize(watch, status=KILLED, peak=0, deadline=RetryDeadline(0))
    assert after is not None
    assert (after.job.status, after.job.error) == (Status.CANCELLED, None)


def test_an_attempt_that_ignores_its_time_limit_is_killed(running: Callable[..., Watch]) -> None:
    time = [0.0]
    watch = running(time, time_limit=10.0)
    time[0] = 12.9
    assert watch.must_end(stop_by=None) is None
    time[0] = 13.0
    assert watch.must_end(stop_by=None) is Reason.TIMED_OUT
    after = finalize(watch, status=KILLED, peak=0, deadline=RetryDeadline(0))
    assert after is not None
    assert after.job.error is not None
    assert (after.job.error.code, "10 s" in after.job.error.detail) == ("timed_out", True)


def test_the_time_limit_option_of_a_job_is_enforced(running: Callable[..., Watch]) -> None:
    time = [0.0]
    watch = running(time, options=Options(time_limit=4.0), time_limit=100.0)
    time[0] = 6.9
    assert watch.must_end(stop_by=None) is None
    time[0] = 7.1
    assert watch.must_end(stop_by=None) is Reason.TIMED_OUT, "its 4 s and a grace of 3 s"
    after = finalize(watch, status=KILLED, peak=0, deadline=RetryDeadline(0))
    assert after is not None
    assert after.job.error is not None
    assert (after.job.error.code, "option time_limit of 4 s" in after.job.error.detail) == ("timed_out", True)


def test_a_time_limit_of_zero_means_no_limit(running: Callable[..., Watch]) -> None:
    time = [0.0]
    watch = running(time, time_limit=0.0)
    time[0] = 1e9
    assert watch.must_end(stop_by=None) is None


def test_a_stopping_worker_requeues_the_job_regardless_of_attempts(jobs: Jobs, running: Callable[..., Watch]) -> None:
    time = [0.0]
    watch = running(time, max_attempts=1)
    assert watch.must_end(stop_by=2.0) is None
    time[0] = 2.0
    assert watch.must_end(stop_by=2.0) is Reason.STOPPING
    after = finalize(watch, status=KILLED, peak=0, deadline=RetryDeadline(0))
    assert after is not None
    assert (after.job.status, after.job.attempt, after.worker) == (Status.QUEUED, 1, None)
    assert after.attempt_id != watch.attempt_id
    assert watch.must_end(stop_by=2.0) is Reason.STOPPING
    time[0] = 3.0
    assert watch.must_end(stop_by=2.0) is Reason.STALE
    assert finalize(watch, status=KILLED, peak=0, deadline=RetryDeadline(0)) is None


def test_a_job_killed_while_its_worker_stops_is_requeued(running: Callable[..., Watch]) -> None:
    for status, expected in ((KILLED, Status.QUEUED), (int(signal.SIGSEGV), Status.FAILED)):
        watch = running([0.0])
        assert watch.must_end(stop_by=100.0) is None
        after = finalize(watch, status=status, peak=0, deadline=RetryDeadline(0))
        assert after is not None
        assert after.job.status is expected


def test_a_job_whose_outcome_the_store_did_not_take_is_repeated(
    jobs: Jobs, running: Callable[..., Watch], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An outage of a minute ends as a longer one does, after which the reconciler repeats the job."""

    def away(*_: object, **__: object) -> None:
        raise StoreUnavailable("The job store", reason="refused")

    def ended(code: int) -> None:
        raise SystemExit(code)

    monkeypatch.setattr("pliant.worker.execution.attempt.run", away)
    monkeypatch.setattr("os._exit", ended)
    delivery = Delivery.create(FUNCTION, args=("some-job", "an-attempt"), connection=redis.Redis())
    delivery.settings = jobs.settings
    with pytest.raises(SystemExit) as exited:
        delivery.perform()
    for attempts, expected in ((2, Status.QUEUED), (1, Status.FAILED)):
        watch = running([0.0], max_attempts=attempts)
        after = finalize(watch, status=int(str(exited.value.code)) << 8, peak=0, deadline=RetryDeadline(0))
        assert after is not None
        assert after.job.status is expected
        assert "The job store did not answer when the job ended." in watch.records.log(watch.id)[0]


def test_an_attempt_that_lost_its_job_is_killed_at_once(jobs: Jobs, running: Callable[..., Watch]) -> None:
    time = [0.0]
    watch = running(time)
    jobs.cancel(watch.id)
    jobs.records.update(watch.id, lambda held: lifecycle.stop(held, attempt_id=watch.attempt_id, now=NOW, retention=0))
    jobs.delete(watch.id)
    assert watch.must_end(stop_by=None) is Reason.STALE
    assert finalize(watch, status=KILLED, peak=0, deadline=RetryDeadline(0)) is None


def test_supervision_continues_while_the_store_is_unavailable(
    running: Callable[..., Watch], monkeypatch: pytest.MonkeyPatch
) -> None:
    time = [0.0]
    watch = running(time)

    def away(*_: object) -> Status | None:
        raise StoreUnavailable("The job store", reason="TimeoutError")

    monkeypatch.setattr(type(watch.records), "beat", away)
    for time[0] in range(100):
        assert watch.must_end(stop_by=None) is None
    monkeypatch.setattr(type(watch.records), "get", away)
    with pytest.raises(StoreUnavailable, match="try again"):
        finalize(watch, status=KILLED, peak=0, deadline=RetryDeadline(0))


def test_crashes_and_out_of_memory_kills_are_distinguished(
    jobs: Jobs, running: Callable[..., Watch], monkeypatch: pytest.MonkeyPatch
) -> None:
    def code(watch: Watch, status: int, peak: int = 0) -> str:
        after = finalize(watch, status=status, peak=peak, deadline=RetryDeadline(0))
        assert after is not None
        assert after.job.error is not None
        assert after.job.error.retryable
        return after.job.error.code

    assert code(running(), KILLED) == "worker_lost"
    assert code(running(memory_limit=1000), KILLED, peak=950) == "out_of_memory"
    assert code(running(memory_limit=1000), KILLED, peak=500) == "worker_lost"
    assert code(running(), 3 << 8) == "worker_lost"
    quiet, starved, segfault = running(), running(), running()
    monkeypatch.setattr(OomKills, "now", classmethod(lambda cls: OomKills(group=10**9, machine=0)))
    assert code(starved, KILLED) == "out_of_memory"
    assert code(segfault, int(signal.SIGSEGV)) == "worker_lost", "the kernel kills the hungry with SIGKILL"
    jobs.records.update(quiet.id, lambda held: held.model_copy(update={"worker": "another"}))
    assert finalize(quiet, status=KILLED, peak=0, deadline=RetryDeadline(0)) is None, (
        "a second delivery must not end the first"
    )


def test_oom_kill_counters_never_decrease() -> None:
    before = OomKills.now()
    after = OomKills.now()
    assert 0 <= before.machine <= after.machine
    assert 0 <= before.group <= after.group
    assert OomKills(1, 0).since(OomKills(0, 0))
    assert not OomKills(1, 1).since(OomKills(1, 1))


def test_calls_are_retried_until_the_store_answers(jobs: Jobs, running: Callable[..., Watch]) -> None:
    watch = running()
    answers = [StoreUnavailable("x", reason="y"), None]

    def call() -> object:
        error = answers.pop(0)
        if error is not None:
            raise error
        return jobs.records.get(watch.id)

    assert RetryDeadline(10).retry(call) == jobs.records.get(watch.id)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("error", "code", "status", "retryable"),
    [
        (InvalidInput("wrong_shape", field="tracks", expected="a", got="b", hint="Do c"), "wrong_shape", 422, False),
        (MemoryError("Unable to allocate"), "out_of_memory", 507, True),
        (OSError(12, "Cannot allocate memory"), "out_of_memory", 507, True),
        (OSError(28, "No space left on device"), "storage_failed", 503, True),
        (FileNotFoundError("Object at location secret not found"), "storage_failed", 503, True),
        (StoreUnavailable("The blob store", reason="gone"), "store_unavailable", 503, True),
        (ZeroDivisionError("secret detail"), "internal_error", 500, False),
        (OSError("no number"), "internal_error", 500, False),
    ],
)  # fmt: skip
def test_every_error_becomes_a_clean_problem(error: BaseException, code: str, status: int, retryable: bool) -> None:
    problem = problem_of(error)
    assert (problem.code, problem.status, problem.retryable) == (code, status, retryable)
    assert problem.detail.endswith(".")
    assert "secret" not in problem.detail
    if isinstance(error, InvalidInput):
        assert (problem.field, problem.expected, problem.got, problem.hint) == ("tracks", "a", "b", "Do c")


def test_a_thread_start_failure_is_out_of_memory_only_under_a_limit() -> None:
    error = RuntimeError("can't start new thread")
    assert problem_of(error, memory_limit=2**30).code == "out_of_memory"
    assert "1.0 GiB" in problem_of(error, memory_limit=2**30).detail
    assert problem_of(error).code == "internal_error"


def test_failure_messages_state_the_limit_signal_or_exit_code() -> None:
    assert "2.0 GiB" in out_of_memory(2**31).detail
    assert "the machine has" in out_of_memory().detail
    assert "1.5 s" in timed_out(1.5).detail
    assert "signal 11 (SIGSEGV)" in how_it_ended(11)
    assert "by signal 40." in how_it_ended(40), "one without a name"
    assert "code 3" in how_it_ended(3 << 8)
    assert isinstance(out_of_memory(), Problem)


def test_progress_never_decreases_and_estimates_the_time_left() -> None:
    reports = []
    time = [100.0]
    reporter = Reporter(reports.append, clock=lambda: time[0])
    reporter.part("loading", 1.0)
    reporter.part("solving", 0.5, stage="cameras", max_reweightings=30)
    time[0] = 110.0
    reporter.part("solving", 0.25, stage="reweight", reweighting=3, objective=2.0)
    reporter.part("exporting", 0.5, residual=0.125)
    reporter.part("exporting", 7.0)
    fractions = [each.fraction for each in reports]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert reports[0].seconds_left is None, "nothing to base it on"
    middle = fractions[2]
    assert middle == pytest.approx(0.02 + 0.83 / 2)
    assert reports[2].seconds_left == pytest.approx(10 * (1 - middle) / middle, abs=0.05)
    assert reports[-1].seconds_left == 0
    assert [each.stage for each in reports] == ["loading", "cameras", "reweight", "exporting", "exporting"]
    assert (reports[-1].reweighting, reports[-1].max_reweightings, reports[-1].objective, reports[-1].residual) == (
        3,
        30,
        2.0,
        0.125,
    )
    edges = sorted(SHARES.values())
    assert edges[0][0] == 0
    assert edges[-1][1] == 1
    assert all(before[1] == after[0] for before, after in itertools.pairwise(edges))


def test_the_solvers_time_estimate_determines_fraction_and_time_left() -> None:
    told: list[Progress] = []
    time = [0.0]
    reporter = Reporter(told.append, clock=lambda: time[0], export_seconds=2.0)
    time[0] = 5.0
    reporter.part("solving", 0.9, stage="cameras", seconds_left=13.0)  # the first report starts the clock
    time[0] = 10.0
    reporter.part("solving", 0.9, stage="reweight", seconds_left=3.0)
    assert (told[-1].seconds_left, told[-1].fraction) == (5.0, pytest.approx(5 / 10))
    reporter.part("solving", 0.9, stage="reweight", seconds_left=93.0)
    assert (told[-1].seconds_left, told[-1].fraction) == (95.0, pytest.approx(5 / 10)), "it does not go back"
    reporter.part("exporting", 0.0)
    assert told[-1].seconds_left == 2.0
    time[0] = 14.0  # twice as slow as expected
    reporter.part("exporting", 0.5)
    assert told[-1].seconds_left == pytest.approx(0.5 * (1 + 4))
    reporter.part("exporting", 1.0)
    assert (told[-1].seconds_left, told[-1].fraction) == (0.0, 1.0)


def test_film_progress_includes_the_planned_solving_time() -> None:
    told: list[Progress] = []
    time = [0.0]
    reporter = Reporter(told.append, clock=lambda: time[0], shares=FILM_SHARES)
    reporter.part("track", 0.0)
    time[0] = 2.0
    reporter.following_seconds = 20.0
    reporter.part("track", 0.25)
    assert (told[-1].seconds_left, told[-1].fraction) == (26.0, pytest.approx(2 / 28))
    time[0] = 8.0
    reporter.part("loading", 1.0)
    assert (told[-1].seconds_left, told[-1].fraction) == (20.0, pytest.approx(8 / 28))
    reporter.part("solving", 0.1, stage="cameras", seconds_left=17.0)
    assert told[-1].seconds_left == 17.0, "then the solver knows better"


def test_time_left_counts_down_between_reports() -> None:
    told: list[Progress] = []
    time = [0.0]
    reporter = Reporter(told.append, clock=lambda: time[0])
    reporter.tick()
    assert told == [], "nothing was reported yet"
    reporter.part("solving", 0.5, stage="cameras", seconds_left=3.0)
    time[0] = 0.9
    reporter.tick()
    assert len(told) == 1
    for now, left in ((1.1, 1.9), (2.2, 0.8), (3.3, 0.0)):
        time[0] = now
        reporter.tick()
        assert (told[-1].stage, told[-1].seconds_left) == ("cameras", pytest.approx(left, abs=0.05))
    time[0] = 9.0
    reporter.part("exporting", 1.0)
    time[0] = 20.0
    reporter.tick()
    assert [(each.fraction, each.seconds_left) for each in told[-2:]] == [(1.0, 0.0)] * 2, "while results are stored"


def test_a_background_thread_ticks_between_reports() -> None:
    ticked = threading.Event()
    threads: list[threading.Thread] = []

    def hear(_: Progress) -> None:
        threads.append(threading.current_thread())
        if len(threads) > 1:
            ticked.set()

    reporter = Reporter(hear)
    with reporter.ticking():
        reporter.part("solving", 0.1, stage="cameras")
        assert ticked.wait(60)
    assert threads[0] is threading.current_thread() is not threads[1]
    assert not threads[1].is_alive()


def test_the_log_is_complete_before_the_record_is_final(
    jobs: Jobs, running: Callable[..., Watch], monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = running([0.0])
    output = working_directory(watch.settings, watch.attempt_id) / OUTPUT
    output.parent.mkdir(parents=True)
    output.write_text("Segmentation fault\n")
    logged: list[str] = []
    update = type(jobs.records).update

    def seen(self: Records, id: str, change: Change) -> Stored:
        logged.extend(self.log(id))
        return update(self, id, change)

    monkeypatch.setattr(type(jobs.records), "update", seen)
    assert finalize(watch, status=KILLED, peak=0, deadline=RetryDeadline(0)) is not None
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ .*SIGKILL.*", logged[0])
    assert logged[1:] == ["Segmentation fault"] == jobs.records.log(watch.id)[1:]

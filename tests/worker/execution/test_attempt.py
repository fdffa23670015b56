"""One try at a job, seen from inside, on a clock of our own: how often it tells, how often it asks."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
from pliant.schemas.job import Interpretation, Progress, Status
from pliant.schemas.options import Options
from pliant.worker.execution.attempt import Attempt
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    time = [0.0]
    monkeypatch.setattr("pliant.worker.execution.attempt.time", SimpleNamespace(monotonic=lambda: time[0]))
    return time


@pytest.fixture
def attempt(jobs: Jobs, now: list[float], inputs_file: Path, interpretation: Interpretation) -> Attempt:
    id = jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation).id
    attempt_id = jobs.records.get(id).attempt_id
    jobs.records.update(
        id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="w", now=datetime.now(UTC))
    )
    return Attempt(jobs=jobs, id=id, attempt_id=attempt_id, deadline=9.0)


def through(now: list[float], seconds: float, each: Callable[[], object]) -> None:
    """Call every hundredth of a second."""
    begin = now[0]
    for step in range(round(100 * seconds)):
        now[0] = begin + step / 100
        each()


def test_progress_is_told_twice_a_second_at_most(jobs: Jobs, attempt: Attempt, now: list[float]) -> None:
    moments: list[float] = []

    def tell() -> None:
        attempt.tell(Progress(stage="reweight", fraction=now[0] / 10, updated_at=datetime.now(UTC)))
        progress = jobs.get(attempt.id).progress
        assert progress is not None
        if progress.fraction == now[0] / 10:
            moments.append(now[0])

    through(now, 2.0, tell)
    assert moments == pytest.approx([0.0, 0.5, 1.0, 1.5])


def test_a_cancel_is_noticed_within_a_quarter_of_a_second(jobs: Jobs, attempt: Attempt, now: list[float]) -> None:
    assert not attempt.should_stop()
    jobs.cancel(attempt.id)
    stopped: list[float] = []
    through(now, 0.5, lambda: stopped.append(now[0]) if attempt.should_stop() else None)
    assert stopped[0] == pytest.approx(0.25)
    attempt.conclude(None)
    assert jobs.get(attempt.id).status is Status.CANCELLED


def test_past_its_time_it_stops_whatever_the_record_says(attempt: Attempt, now: list[float]) -> None:
    assert not attempt.should_stop()
    now[0] = 9.0
    assert attempt.should_stop()

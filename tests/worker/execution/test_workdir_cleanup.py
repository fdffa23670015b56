"""Cleanup after a job process has ended, with a store that is unavailable for a while."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.worker.errors import StoreUnavailable
from pliant.worker.execution.monitor import RetryDeadline, Watch
from pliant.worker.execution.rq_worker import PliantWorker
from pliant.worker.execution.workdir import working_directory
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.records import Stored, utc_now
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect


class Clock:
    """Pauses that take no time."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.worker.execution.monitor.time", Clock())


def test_all_retried_calls_share_one_time_limit() -> None:
    asked: list[str] = []

    def gone() -> None:
        asked.append("again")
        raise StoreUnavailable("The store", reason="gone")

    deadline = RetryDeadline(0.7)
    with pytest.raises(StoreUnavailable):
        deadline.retry(gone)
    assert len(asked) > 1
    asked.clear()
    with pytest.raises(StoreUnavailable):
        deadline.retry(gone)
    assert asked == ["again"], "tried once, though the time is over"


@pytest.mark.parametrize("away", ["it comes back", "it stays away"])
def test_scratch_files_are_removed_once_the_store_confirms_their_owner(
    jobs: Jobs,
    settings: Settings,
    inputs_file: Path,
    interpretation: Interpretation,
    monkeypatch: pytest.MonkeyPatch,
    away: str,
) -> None:
    connection = connect(settings.redis, decode=False)
    worker = PliantWorker(
        settings=jobs.settings,
        connection=connection,
        quick=connection,
        records=jobs.records,
        queue=jobs.queue,
        name="me",
    )
    id = jobs.submit(inputs_file, Submission(options=Options()), interpretation=interpretation)[0].id
    attempt_id = jobs.records.get(id).attempt_id
    jobs.records.update(id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="me", now=utc_now()))
    folder = working_directory(jobs.settings, attempt_id)
    folder.mkdir(parents=True)
    (folder / "half.npz").write_bytes(b"half")
    watch = Watch(jobs.settings, jobs.records, id=id, attempt_id=attempt_id, worker="me")
    delivery = SimpleNamespace(id=id)
    looks: list[str] = []
    get = jobs.records.get

    def stammering(wanted: str) -> Stored:
        looks.append(wanted)
        if len(looks) > 1 and (away == "it stays away" or len(looks) < 4):  # the first read is finalize's
            raise StoreUnavailable("The store", reason="gone")
        return get(wanted)

    monkeypatch.setattr(jobs.records, "get", stammering)
    worker._stop_by = 0.0  # a stopping worker has two seconds
    worker._reap(watch, delivery, status=9, peak=0)  # type: ignore[arg-type]
    connection.close()
    assert len(looks) >= 4
    assert folder.exists() == (away == "it stays away"), "whose files nobody can say, the reconciler clears"

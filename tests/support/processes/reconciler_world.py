"""Jobs in memory and a reconciler, on clocks that a test advances."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.service import Jobs
from pliant.worker.maintenance.reconciler import Reconciler
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.memory import MemoryQueue, MemoryRecords


class World:
    """Jobs in memory, a reconciler, and the wall and monotonic clocks that a test advances."""

    def __init__(self, data: Path, **settings: object) -> None:
        self.now = datetime(2030, 1, 1, tzinfo=UTC)
        self.monotonic = 1000.0
        self.jobs = Jobs(
            records=MemoryRecords(),
            blobs=Blobs.open("memory:///"),
            queue=MemoryQueue(),
            settings=Settings(data=data, lost_after=5.0, retention=60.0, max_attempts=2, **settings),  # type: ignore[arg-type]
            clock=lambda: self.now,
        )
        self.reconciler = Reconciler(jobs=self.jobs, clock=lambda: self.monotonic)
        self.reconciler.tick()

    def pass_seconds(self, seconds: float, *, meanwhile: Callable[[], object] = lambda: None) -> None:
        for _ in range(round(seconds)):
            self.monotonic += 1
            self.now += timedelta(seconds=1)
            meanwhile()
            self.reconciler.tick()

    def claim(self, id: str) -> str:
        attempt_id = self.jobs.records.get(id).attempt_id
        self.jobs.queue.remove(attempt_id)
        self.jobs.records.update(
            id, lambda held: lifecycle.claim(held, attempt_id=attempt_id, worker="w", now=self.now)
        )
        return attempt_id

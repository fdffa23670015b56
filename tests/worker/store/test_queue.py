"""The queue: held-back jobs, and removal of deliveries that a worker is taking."""

from __future__ import annotations

import time

from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from pliant.worker.store.queue import RedisQueue
from rq.executions import ExecutionRegistry


def test_the_queue_marks_held_back_jobs(jobs: Jobs) -> None:
    queue = jobs.queue
    for attempt_id in ("job-1", "job-2"):
        queue.hold(attempt_id)
    assert (queue.held(), queue.waiting()) == ({"job-1", "job-2"}, [])
    queue.push("job", "job-3")
    queue.release("job-1")
    queue.release("job-3")
    queue.remove("job-2")
    assert (queue.held(), queue.waiting()) == (set(), ["job-3"])


def test_a_delivery_being_dropped_by_a_worker_can_be_removed(settings: Settings) -> None:
    """An execution entry of a delivery may vanish between listing and reading it."""
    raw = connect(settings.redis, decode=False)
    queue = RedisQueue(raw, name=settings.queue)
    queue.push("job", "job-1")
    notes = ExecutionRegistry("job-1", connection=raw)
    raw.zadd(notes.key, {"a-note-that-is-gone": time.time() + 60})
    queue.remove("job-1")
    assert queue.waiting() == []
    assert raw.exists("rq:job:job-1") == 0
    raw.delete(notes.key)
    raw.close()

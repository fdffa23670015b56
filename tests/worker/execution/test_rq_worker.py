"""The RQ worker during a job: its own writes do not delay supervision."""

from __future__ import annotations

import time

import pytest
import redis
from pliant.worker.execution.rq_worker import ALIVE_FOR, IDLE_WAKE, Delivery, PliantWorker
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from pliant.worker.store.queue import FUNCTION, RedisQueue
from pliant.worker.store.redis import RedisRecords
from rq.exceptions import DequeueTimeout
from rq.serializers import JSONSerializer

PAUSE = 3.0
"""Seconds during which the server does not answer."""


def test_heartbeats_do_not_delay_supervision_while_the_server_hangs(settings: Settings) -> None:
    connection, quick = (connect(settings.redis, decode=False, retries=0, answer_within=each) for each in (30.0, 0.3))
    text = connect(settings.redis, decode=True)
    worker = PliantWorker(
        settings=settings, connection=connection, quick=quick, records=RedisRecords(text, prefix=settings.queue),
        queue=RedisQueue(connection, name=settings.queue), name="me",
    )  # fmt: skip
    job = Delivery.create(
        FUNCTION, args=("a-job", "a-job-1"), id="a-job-1", connection=connection, serializer=JSONSerializer,
        origin=settings.queue,
    )  # fmt: skip
    job.save()
    worker.register_birth()
    worker.execution = worker.prepare_execution(job)
    worker._keep_execution(job)
    before = connection.hget(job.key, "last_heartbeat")
    assert before
    connection.execute_command("CLIENT", "PAUSE", int(1000 * PAUSE))
    begun = time.monotonic()
    worker._keep_execution(job)
    assert time.monotonic() - begun < 0.9 * PAUSE
    connection.ping()  # waits until the pause is over
    worker._keep_execution(job)
    assert connection.hget(job.key, "last_heartbeat") > before
    assert worker.connection is connection
    for each in (connection, quick, text):
        each.close()


def test_an_idle_worker_returns_soon_after_each_of_many_outages(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    connection, text = connect(settings.redis, decode=False), connect(settings.redis, decode=True)
    worker = PliantWorker(
        settings=settings, connection=connection, quick=connection, records=RedisRecords(text, prefix=settings.queue),
        queue=RedisQueue(connection, name=settings.queue), name="me",
    )  # fmt: skip
    outages = iter([redis.ConnectionError("away"), DequeueTimeout(0, "idle")] * 10)

    def dequeued(*_: object, **__: object) -> None:
        for each in outages:
            raise each

    pauses: list[float] = []
    monkeypatch.setattr(worker.queue_class, "dequeue_any", dequeued)
    monkeypatch.setattr("rq.worker.base.time.sleep", pauses.append)
    assert worker.dequeue_job_and_maintain_ttl(IDLE_WAKE) is None
    assert len(pauses) == 10
    assert max(pauses) < ALIVE_FOR / 2
    for each in (connection, text):
        each.close()


def test_a_worker_is_listed_again_after_the_store_lost_its_entry(settings: Settings) -> None:
    """Otherwise it works unseen, `/readyz` reports that there are no workers, and no job is measured against its memory."""
    connection, text = connect(settings.redis, decode=False), connect(settings.redis, decode=True)
    queue = RedisQueue(connection, name=settings.queue)
    worker = PliantWorker(
        settings=settings, connection=connection, quick=connection, records=RedisRecords(text, prefix=settings.queue),
        queue=queue, name="cut-off",
    )  # fmt: skip
    worker.register_birth()
    worker.heartbeat()
    assert queue.workers() == ["cut-off"]
    connection.delete(worker.key)  # it expires while the worker is cut off for more than a minute
    queue.clean_up()
    assert queue.workers() == []
    worker.heartbeat()
    assert queue.workers() == ["cut-off"]
    worker.register_death()
    queue.clean_up()
    for each in (connection, text):
        each.close()

"""RQ's own view of a long job: its entry is kept alive while the job runs, so RQ never declares it abandoned."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pliant.schemas.job import Status
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from rq import Queue as RqQueue
from rq.registry import FailedJobRegistry, StartedJobRegistry
from rq.serializers import JSONSerializer
from worker_house import House

from benchmarks.installation.instance import children

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="job processes die with their worker on Linux"),
    pytest.mark.slow,
]

LEASE = 2
"""Seconds until RQ abandons an entry without a heartbeat; 90 by default."""

WORKER = f"""
import sys
from pliant.worker import __main__ as main
from pliant.worker.execution import rq_worker
rq_worker.PliantWorker.get_heartbeat_ttl = lambda self, job: {LEASE}
rq_worker.IDLE_WAKE = int(sys.argv[1])
sys.exit(main.main(["work"]))
"""


def test_a_job_longer_than_rqs_lease_is_not_abandoned(
    settings: Settings, inputs_files: tuple[Path, Path], caplog: pytest.LogCaptureFixture
) -> None:
    """Without a heartbeat, RQ ended every job of more than 90 s with `AbandonedJobError`, although it succeeded."""
    assert registered(settings, inputs_files, beat_every=1) == (1, 0)
    assert [record for record in caplog.records if record.levelno >= logging.ERROR] == []


def test_without_a_heartbeat_a_long_job_is_abandoned(settings: Settings, inputs_files: tuple[Path, Path]) -> None:
    """Control for the test above: the same job is declared abandoned if its heartbeat comes too late."""
    assert registered(settings, inputs_files, beat_every=60) == (0, 1)


def registered(settings: Settings, inputs: tuple[Path, Path], *, beat_every: int) -> tuple[int, int]:
    """Run a long job past RQ's lease, with RQ's clean-up under way; return the numbers of its started and failed entries."""
    house = House(settings, inputs=inputs, children=[])
    raw = connect(settings.redis, decode=False)
    queue = RqQueue(settings.queue, connection=raw, serializer=JSONSerializer)
    env = {**os.environ, **settings.to_environment()}
    worker = subprocess.Popen([sys.executable, "-c", WORKER, str(beat_every)], env=env)
    try:
        id = house.submit(long=True)
        house.until(lambda: house.jobs.get(id).status is Status.RUNNING and children(worker.pid), "it runs")
        (job_process,) = children(worker.pid)
        os.kill(job_process, signal.SIGSTOP)  # a long job that takes no processor time; the heartbeat is the worker's
        until = time.monotonic() + LEASE + 1.5
        while time.monotonic() < until:
            house.jobs.queue.clean_up()
            time.sleep(0.2)
        started = StartedJobRegistry(queue=queue).get_job_ids(cleanup=False)
        failed = FailedJobRegistry(queue=queue).get_job_ids(cleanup=False)
        assert house.jobs.get(id).status is Status.RUNNING, "our own record is not concerned"
        os.kill(job_process, signal.SIGCONT)
        house.jobs.cancel(id)
        house.until(lambda: house.jobs.get(id).status.final, "it ends")
        return len(started), len(failed)
    finally:
        worker.terminate()
        worker.wait(20)
        raw.close()

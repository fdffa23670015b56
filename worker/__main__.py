"""`python -m pliant.worker [work|reconcile]`: run a worker or a reconciler, configured by `PLIANT_…` variables."""

from __future__ import annotations

import gc
import importlib
import os
import secrets
import signal
import sys
from types import FrameType

from pliant.worker.environment import read
from pliant.worker.errors import ForeignStore, StoreUnavailable, WorkerError
from pliant.worker.execution.rq_worker import PliantWorker
from pliant.worker.jobs.foreign_store import check_at_start, check_before_forking
from pliant.worker.jobs.service import Jobs
from pliant.worker.logs import LogSettings, configure_logging
from pliant.worker.maintenance.reconciler import Reconciler
from pliant.worker.processes.containment import NUMERICAL_THREADS
from pliant.worker.processes.preflight import check_process, open_data_directory
from pliant.worker.settings import Settings
from pliant.worker.store.connection import BLOCK_WITHIN, connect, reachable
from pliant.worker.store.outage import described
from pliant.worker.store.queue import RedisQueue
from pliant.worker.store.redis import RedisRecords
from pliant.worker.webhooks.sender import WebhookSender

USAGE = "usage: python -m pliant.worker [work|reconcile]"

PRELOADED = (
    "pliant.worker.formats.canonical",
    "pliant.worker.execution.pipeline",
    "pliant.worker.execution.film",
    "pliant.worker.execution.further_outputs",
)

WATCH_ANSWERS_WITHIN = 2.0
"""Time limit of a heartbeat, seconds: supervision of the job must continue when the store hangs."""


def work(settings: Settings) -> int:
    """Run jobs until a signal.

    The modules of a job are imported once, before the first fork. This is safe because this process does no numerical work:
    the numerical library stops its threads in the fork and restarts them in the job process.
    """
    open_data_directory(settings)
    check_before_forking(settings)
    for variable in NUMERICAL_THREADS:
        os.environ.setdefault(variable, "1")
    for module in PRELOADED:
        importlib.import_module(module)
    gc.collect()
    gc.freeze()  # otherwise the first garbage collection of every job process would copy all shared pages
    quick, text = (
        connect(settings.redis, decode=decode, retries=0, answer_within=WATCH_ANSWERS_WITHIN)
        for decode in (False, True)
    )
    connection = connect(settings.redis, decode=False, answer_within=BLOCK_WITHIN)
    records = RedisRecords(text, prefix=settings.queue)
    records.ping()  # the supervisor repeats a start without a store
    with reachable():  # RQ connects at once
        worker = PliantWorker(
            settings=settings,
            connection=connection,
            quick=quick,
            records=records,
            queue=RedisQueue(connection, name=settings.queue),
            name=secrets.token_hex(6),
        )
        worker.work(logging_level=None)
        if worker.forbidden is not None:
            raise worker.forbidden
    if worker.foreign_store:
        raise ForeignStore(settings.blobs)
    return 0


def reconcile(settings: Settings) -> int:
    """Run the reconciler and the webhook sender until a signal."""
    stopping = False

    def stop(signum: int, frame: FrameType | None) -> None:  # noqa: ARG001
        nonlocal stopping
        stopping = True

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    if settings.blob_url is None:
        open_data_directory(settings)
    jobs = Jobs.open(settings)
    jobs.records.ping()  # the supervisor repeats a start without a store
    check_at_start(jobs)  # it would remove the files of another installation
    sender = WebhookSender.open(settings, jobs.records)
    sender.start()
    Reconciler(jobs=jobs).run(lambda: stopping or not sender.alive)  # the supervisor restarts a failed sender
    sender.stop()
    return 0


def main(arguments: list[str]) -> int:
    """Run one process; return its exit code."""
    tasks = {"work": work, "reconcile": reconcile}
    task = tasks.get(arguments[0] if arguments else "work")
    if task is None or len(arguments) > 1:
        sys.stderr.write(f"{USAGE}\n")
        return 2
    try:
        logs, settings = read(LogSettings), Settings.from_environment()
        configure_logging(logs.log_level, logs.log_format)
        check_process(settings)
        try:
            return task(settings)
        except StoreUnavailable as error:
            sys.stderr.write(f"{described(error, settings.redis)}\n")
            return 1
    except WorkerError as error:
        sys.stderr.write(f"{error}\n")
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

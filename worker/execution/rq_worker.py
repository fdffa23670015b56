"""The RQ worker: RQ dequeues and forks; this module validates deliveries, supervises job processes and reaps them.

Disabled features of RQ, with the reason: job timeout (its alarm waits for a C call to return), maintenance (detects a
lost job after minutes, and two instances queue it twice), scheduler (a forked one keeps a dead worker's connection and
loses jobs), commands (a thread beside a fork), callbacks and webhooks named by a delivery (whoever can write to Redis
could name any function).
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from contextlib import suppress
from types import FrameType
from typing import Any

import redis
from pliant.schemas.job import Status
from pliant.worker.errors import ForeignStore, StoreUnavailable, UnknownJob
from pliant.worker.execution import attempt as work
from pliant.worker.execution.failures import FOREIGN_STORE, UNRECORDED, was_foreign
from pliant.worker.execution.monitor import RetryDeadline, Watch, finalize
from pliant.worker.execution.workdir import clean_up
from pliant.worker.jobs.lifecycle import ACTIVE
from pliant.worker.jobs.submission import order_waiting
from pliant.worker.processes.containment import die_with_parent
from pliant.worker.processes.memory import memory_for_a_job
from pliant.worker.records import Records
from pliant.worker.settings import Settings
from pliant.worker.store.queue import FUNCTION, Queue, alive_key
from rq import Queue as RqQueue
from rq import Worker, worker_registration
from rq.exceptions import StopRequested
from rq.job import Job as RqJob
from rq.serializers import JSONSerializer
from rq.worker import WorkerStatus

logger = logging.getLogger(__name__)

IDLE_WAKE = 5
"""Seconds an idle worker waits for a delivery between heartbeats."""

ALIVE_FOR = 20
"""Seconds for which a worker counts as running after its last heartbeat."""

RSS_UNIT = 1 if sys.platform == "darwin" else 1024
"""Bytes in one unit of `ru_maxrss`."""

AWAY = (redis.ConnectionError, redis.TimeoutError)
"""Exceptions of an unavailable Redis."""

FORBIDDEN = redis.exceptions.NoPermissionError
"""Exception of a Redis whose access rules forbid a command. During a job it is treated like an outage; an idle worker ends with it."""

LEAVE_FOR = 1.0
"""Seconds that a worker waits after requeuing a job that is too large for it, so that another worker can take the job."""

POLL = 0.05
"""Seconds between checks of a running job process."""


class Delivery(RqJob):
    """A delivery of a job's attempt. It runs `attempt.run` only, whatever function it names."""

    settings: Settings | None = None

    def perform(self) -> None:
        """Run the attempt; reject deliveries of other functions."""
        named, arguments = self.func_name, list(self.args)
        fits = len(arguments) == 2 and all(isinstance(each, str) for each in arguments) and not self.kwargs
        if named != FUNCTION or not fits or self.settings is None:
            raise PermissionError(
                f"rejected a delivery of {named!r} with {len(arguments)} arguments, which is not an attempt"
            )
        try:
            work.run(arguments[0], arguments[1], settings=self.settings, worker=str(self.worker_name))
        except StoreUnavailable as error:
            logger.warning("job %s: the outcome is not recorded: %s", arguments[0], error, extra={"job": arguments[0]})
            # RQ would end with the code of any error, and the worker could not tell an outage from a crash.
            os._exit(UNRECORDED)
        except ForeignStore:  # the worker reports it
            os._exit(FOREIGN_STORE)

    @property
    def success_callback(self) -> None:
        """None: deliveries cannot name callbacks."""

    failure_callback = stopped_callback = success_callback

    def send_webhooks(self, *_: Any, **__: Any) -> None:
        """Do nothing: deliveries cannot name webhooks."""


class PliantWorker(Worker):
    """One job at a time, each in a forked job process.

    Parameters
    ----------
    connection : Redis
        Connection on which RQ waits for deliveries.
    quick : Redis
        Connection for heartbeats during a job. A hanging store delays supervision by the time limits of `quick` and `records`.
    """

    max_connection_wait_time = float(IDLE_WAKE)
    """Longest pause before the store is tried again, seconds; RQ doubles the pause with each outage since the worker's last job."""

    def __init__(
        self, *, settings: Settings, connection: redis.Redis, quick: redis.Redis, records: Records, queue: Queue,
        name: str,
    ) -> None:  # fmt: skip
        rq_queue = RqQueue(settings.queue, connection=connection, serializer=JSONSerializer, job_class=Delivery)
        super().__init__(
            [rq_queue],
            name=name,
            connection=connection,
            serializer=JSONSerializer,
            job_class=Delivery,
            worker_ttl=IDLE_WAKE + 15,
            log_job_description=False,
        )
        self._settings = settings
        self._quick = quick
        self._records = records
        self._deliveries = queue
        self._stop_by: float | None = None
        self._memory = memory_for_a_job(settings)
        self.forbidden: redis.exceptions.NoPermissionError | None = None
        """The missing permission that the worker has ended with."""
        self.foreign_store = False
        """Whether the worker has ended because no job has its files in its blob store."""

    def subscribe(self) -> None:
        """Do not listen for commands: jobs are cancelled through their record, and forking is safer without threads."""

    def unsubscribe(self) -> None:
        """Do nothing; see `subscribe`."""

    def run_maintenance_tasks(self) -> None:
        """Do nothing: the reconciler requeues lost jobs."""

    @property
    def should_run_maintenance_tasks(self) -> bool:
        """Never; see `run_maintenance_tasks`."""
        return False

    def check_for_suspension(self, burst: bool) -> None:
        """Do nothing: workers are never suspended, and the check would need the store."""

    def set_state(self, state: str, pipeline: Any = None) -> None:
        """Set the state, also in RQ's records if the store is available."""
        try:
            super().set_state(state, pipeline)
        except AWAY as error:
            logger.warning("state %s not written: %s", state, error)

    def heartbeat(self, timeout: int | None = None, pipeline: Any = None) -> None:
        """Send RQ's heartbeat and the worker's own, which expires with it; an unavailable store is ignored."""
        target: Any = pipeline if pipeline is not None else self.connection
        try:
            super().heartbeat(timeout, pipeline)
            sign = f"{os.getpid()} {self._memory}"
            target.set(alive_key(self._settings.queue, self.name), sign, ex=ALIVE_FOR)
            # The clean-up removes a worker that was cut off from the store, and a store may lose its data.
            worker_registration.register(self, target)
        except AWAY as error:
            logger.warning("heartbeat not written: %s", error)

    def dequeue_job_and_maintain_ttl(self, timeout: int | None, max_idle_time: int | None = None) -> Any:
        """Wait for a delivery; stop if the store forbids it, since RQ would only log a traceback, or if the files are elsewhere."""
        try:
            if self.foreign_store:
                raise StopRequested
            return super().dequeue_job_and_maintain_ttl(timeout, max_idle_time)
        except FORBIDDEN as error:
            self.forbidden = error
            raise StopRequested from error

    def prepare_job_execution(self, job: RqJob, remove_from_intermediate_queue: bool = False) -> None:
        """Write RQ's entry of the delivery, in the job process; if the store forbids it, end without failing the job."""
        try:
            super().prepare_job_execution(job, remove_from_intermediate_queue)
        except FORBIDDEN as error:
            id, _ = _ids_of(job)
            logger.warning("job %s: not started: %s", id, error, extra={"job": id})
            os._exit(UNRECORDED)

    def execute_job(self, job: RqJob, queue: RqQueue) -> None:
        """Run a delivery. If the store becomes unavailable before the fork, the reconciler delivers the job again."""
        try:
            if self._leave_to_a_larger(job):
                return
            super().execute_job(job, queue)
        except (*AWAY, FORBIDDEN) as error:
            if self.horse_pid:
                raise
            id, _ = _ids_of(job)
            logger.warning("job %s: delivery %s: %s", id, job.id, error, extra={"job": id})

    def _leave_to_a_larger(self, job: RqJob) -> bool:
        """Requeue a job that needs more memory than this worker has, if another worker has enough; return True if it was requeued."""
        id, attempt_id = _ids_of(job)
        try:
            held = self._records.get(id)
            estimate = held.job.interpretation.estimate
            if held.attempt_id != attempt_id or estimate is None or estimate.memory_bytes <= self._memory:
                return False
            memories = self._deliveries.memories()
            if not any(size >= estimate.memory_bytes for name, size in memories.items() if name != self.name):
                return False  # the estimate may be too high; if it is not, the job fails with a reason
            self._deliveries.remove(attempt_id)
            self._deliveries.push(id, attempt_id)
        except (StoreUnavailable, UnknownJob):
            return False
        time.sleep(LEAVE_FOR)
        return True

    def request_stop(self, signum: int, frame: FrameType | None) -> None:  # noqa: ARG002
        """Handle SIGTERM: exit if idle; otherwise let the job continue for the grace period, which a second signal ends."""
        first = self._stop_by is None
        self._stop_by = time.monotonic() + (self._settings.stop_grace if first else 0.0)
        self._stop_requested = True
        if self.get_state() != WorkerStatus.BUSY and not self.horse_pid:
            raise StopRequested

    request_force_stop = request_stop

    def kill_horse(self, sig: signal.Signals = signal.SIGKILL) -> None:
        """Kill the job process and its children, unless it still shares the worker's process group."""
        with suppress(ProcessLookupError):
            if os.getpgid(self.horse_pid) == self.horse_pid:
                os.killpg(self.horse_pid, sig)
            else:
                os.kill(self.horse_pid, sig)

    def main_work_horse(self, job: RqJob, queue: RqQueue) -> None:
        """Run the delivery in the job process, which ends with the worker."""
        die_with_parent(int(os.environ["PLIANT_WORKER_PROCESS"]), how=signal.SIGKILL)
        job.settings = self._settings  # type: ignore[attr-defined]
        super().main_work_horse(job, queue)

    def setup_work_horse_signals(self) -> None:
        """Ignore SIGTERM and SIGINT, which may be sent to all processes of a service: the worker stops its job process."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    def fork_work_horse(self, job: RqJob, queue: RqQueue) -> None:
        """Fork, after recording the worker's process id: the worker may end before the job process can read it."""
        os.environ["PLIANT_WORKER_PROCESS"] = str(os.getpid())
        super().fork_work_horse(job, queue)

    def monitor_work_horse(self, job: RqJob, queue: RqQueue) -> None:  # noqa: ARG002
        """Wait for the job process, record the outcome, clean up."""
        id, attempt_id = _ids_of(job)
        watch = Watch(self._settings, self._records, id=id, attempt_id=attempt_id, worker=self.name)
        next_sign = time.monotonic() + IDLE_WAKE
        while True:
            pid, status, usage = os.wait4(self.horse_pid, os.WNOHANG)
            if pid:
                break
            if watch.must_end(stop_by=self._stop_by) is not None:
                self.kill_horse()
            if time.monotonic() > next_sign:
                next_sign = time.monotonic() + IDLE_WAKE
                self._keep_execution(job)
            time.sleep(POLL)
        self._horse_pid = 0
        self.foreign_store = was_foreign(status)
        self._reap(watch, job, status=status, peak=usage.ru_maxrss * RSS_UNIT)

    def _keep_execution(self, job: RqJob) -> None:
        """Write the worker's heartbeat, and RQ's for the delivery: without it RQ abandons every job of more than 90 s."""
        patient, self.connection = self.connection, self._quick
        try:
            self.maintain_heartbeats(job)
        except (*AWAY, FORBIDDEN) as error:
            logger.warning("heartbeat not written: %s", error)
        finally:
            self.connection = patient

    def _reap(self, watch: Watch, job: RqJob, *, status: int, peak: int) -> None:
        deadline = RetryDeadline(60.0 if self._stop_by is None else 2.0)
        try:
            settled = finalize(watch, status=status, peak=peak, deadline=deadline)
            if settled is not None and settled.job.status is Status.QUEUED:
                fresh = settled.attempt_id
                deadline.retry(lambda: self._deliveries.push(watch.id, fresh, front=True))  # it has waited before
                deadline.retry(lambda: order_waiting(self._records, self._deliveries, [settled.owner]))
            deadline.retry(lambda: self._deliveries.remove(job.id))
        except StoreUnavailable as error:
            logger.warning("job %s: %s; the reconciler will requeue it", watch.id, error, extra={"job": watch.id})
        finally:
            with suppress(StoreUnavailable):  # otherwise the reconciler removes the files
                if not deadline.retry(lambda: self._elsewhere(watch)):
                    clean_up(self._settings, watch.attempt_id)

    def _elsewhere(self, watch: Watch) -> bool:
        """Return whether another worker runs this attempt: then this delivery is a duplicate and does not own the scratch directory."""
        try:
            held = self._records.get(watch.id)
        except UnknownJob:
            return False
        return held.attempt_id == watch.attempt_id and held.worker != watch.worker and held.job.status in ACTIVE


def _ids_of(delivery: RqJob) -> tuple[str, str]:
    """Return the ids of job and attempt that a delivery carries; empty for what it lacks, as only a foreign one does."""
    id, attempt_id = (str(each) for each in (*delivery.args, "", "")[:2])
    return id, attempt_id

"""Faults in job processes, workers, the reconciler, Valkey, and the job itself."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from dataclasses import replace
from threading import Thread

from pliant.client import Status
from pliant.solver.gallery import face

from benchmarks.installation.fault_list import LARGE, SHORT, Fault, Outcome, cancelled, fault, status_of, submitted
from benchmarks.installation.instance import SOON, Instance, children, running
from benchmarks.installation.long_jobs import LONG


@fault("kill -9 the job process in mid solve")
def job_process(instance: Instance) -> Outcome:
    id = submitted(instance, options=LONG)
    instance.midst(id, "reweight")
    instance.kill("job process")
    began = time.monotonic()
    job = instance.final(id)
    assert job.status is Status.FAILED
    assert job.error is not None
    assert (job.error.code, job.error.retryable, job.artifacts) == ("worker_lost", True, [])
    return Outcome(status_of(job), time.monotonic() - began)


@fault("kill -9 the job process while it writes its files")
def job_process_writing(instance: Instance) -> Outcome:
    id = submitted(instance, frames=60, points=8000, options=LARGE)
    attempt_id = instance.jobs.records.get(id).attempt_id
    instance.until(lambda: any((instance.settings.work / attempt_id).glob("artifacts/*")), "a file is begun")
    instance.kill("job process")
    began = time.monotonic()
    job = instance.final(id)
    assert (job.status, job.artifacts) == (Status.FAILED, [])
    return Outcome(f"{status_of(job)}, no file visible", time.monotonic() - began)


TRIES = 8
"""Maximum number of jobs until one is hit while it stores its files."""


@fault("kill -9 the job process while it stores its files")
def job_process_storing(instance: Instance) -> Outcome:
    for _ in range(TRIES):
        id = submitted(instance, frames=60, points=8000, options=LARGE)
        prefix = f"jobs/{id}/"
        blobs = instance.settings.data / "blobs"
        attempt = instance.settings.work / instance.jobs.records.get(id).attempt_id
        instance.until(lambda at=attempt: any(at.glob("artifacts/*")), "a file is begun")
        # Storing takes milliseconds, so the process runs in steps of half a millisecond until its first file appears.
        for process in instance.look()["job process"]:
            with suppress(ProcessLookupError):
                while not any(blobs.glob(f"{prefix}*/artifacts/*")):
                    os.kill(process, signal.SIGCONT)
                    time.sleep(0.0005)
                    os.kill(process, signal.SIGSTOP)
                os.kill(process, signal.SIGKILL)
        began = time.monotonic()
        job = instance.final(id)
        if job.status is Status.FAILED:
            assert job.artifacts == []
            return Outcome(f"{status_of(job)}, no file visible", time.monotonic() - began)
        assert job.status is Status.SUCCEEDED  # it finished before the signal
        assert job.artifacts != []
    raise AssertionError(f"none of {TRIES} jobs was hit while it stored its files")


@fault("kill -9 a worker in mid solve")
def worker(instance: Instance) -> Outcome:
    id = submitted(instance, options=LONG)
    instance.midst(id, "reweight")
    (pid,) = [pid for pid in instance.look()["worker"] if children(pid)]
    os.kill(pid, signal.SIGKILL)
    seconds = instance.until(lambda: instance.jobs.get(id).attempt == 2, "another worker has it")
    cancelled(instance, id)
    return Outcome("running, attempt 2 (cancelled then)", seconds)


@fault("kill -9 the reconciler in mid solve")
def reconciler(instance: Instance) -> Outcome:
    id = submitted(instance, options={"max_reweightings": 30})
    instance.midst(id, "reweight")
    old = instance.kill("reconciler")
    seconds = instance.until(lambda: instance.look()["reconciler"] not in ([], [old]), "another reconciler")
    job = instance.final(id)
    assert (job.status, job.attempt) == (Status.SUCCEEDED, 1)
    return Outcome(status_of(job), seconds)


@fault("kill -9 Valkey in mid solve")
def valkey(instance: Instance) -> Outcome:
    id = submitted(instance, options=LONG)
    instance.midst(id, "reweight")
    instance.kill("valkey")
    time.sleep(0.1)
    seconds = instance.until(lambda: instance.jobs.get(id).status is Status.RUNNING, "it answers again")
    before = instance.jobs.get(id).progress
    instance.until(lambda: instance.jobs.get(id).progress != before, "the job keeps reporting progress")
    assert instance.jobs.get(id).attempt == 1
    cancelled(instance, id)
    return Outcome("running, attempt 1 (cancelled then)", seconds)


AWAY = [4.0]
"""Seconds of Valkey's outage; set by the command line."""


@fault("Valkey hangs (SIGSTOP) in mid solve")
def valkey_hangs(instance: Instance) -> Outcome:
    id = submitted(instance, options=LONG)
    instance.midst(id, "reweight")
    pid = instance.kill("valkey", signal.SIGSTOP)
    began = time.monotonic()
    time.sleep(AWAY[0])
    os.kill(pid, signal.SIGCONT)
    before = instance.jobs.get(id).progress
    instance.until(lambda: instance.jobs.get(id).progress != before, "the job keeps reporting progress")
    assert instance.jobs.get(id).attempt == 1, "an outage is no reason to begin a job anew"
    seconds = time.monotonic() - began
    cancelled(instance, id)
    return Outcome(f"running, attempt 1, after {AWAY[0]:g} s away (cancelled then)", seconds)


@fault("Valkey is killed again and again, while clients wait and submit")
def valkey_down(instance: Instance) -> Outcome:
    id = submitted(instance, options={"max_reweightings": 30})
    instance.midst(id, "reweight")
    ends: list[Status] = []

    def wait() -> None:
        with instance.client() as client:
            ends.append(client.wait(id, load=False, timeout=240).job.status)

    waiting = Thread(target=wait)
    waiting.start()
    began = time.monotonic()
    while time.monotonic() < began + AWAY[0]:
        for pid in instance.look()["valkey"]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.05)
    other = submitted(instance, options=SHORT)
    job = instance.final(id)
    waiting.join(240)
    assert (job.status, ends, instance.final(other).status) == (Status.SUCCEEDED, [job.status], Status.SUCCEEDED)
    return Outcome(f"{status_of(job)}, {AWAY[0]:g} s away; both clients noticed nothing", time.monotonic() - began)


@fault(
    "worker and job process frozen beyond the lease while the files are written, resumed when another has finished the job"
)
def frozen(instance: Instance) -> Outcome:
    id = submitted(instance, frames=60, points=8000, options=LARGE)
    stale = instance.jobs.records.get(id).attempt_id
    instance.until(lambda: any((instance.settings.work / stale).glob("artifacts/*")), "a file is begun")
    (old,) = [pid for pid in instance.look()["worker"] if children(pid)]
    pids = [old, *children(old)]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    began = time.monotonic()
    job = instance.final(id)
    seconds = time.monotonic() - began
    held = instance.jobs.records.get(id)
    for pid in reversed(pids):
        os.kill(pid, signal.SIGCONT)
    instance.until(lambda: not any(running(pid) for pid in pids[1:]), "the stale job process ends")
    time.sleep(0.5)
    assert instance.jobs.records.get(id) == held, "the stale attempt wrote nothing"
    assert (job.status, job.attempt) == (Status.SUCCEEDED, 2)
    return Outcome(f"{status_of(job)}; the first one wrote nothing", seconds)


@fault("one attempt delivered to two workers at once")
def twice(instance: Instance) -> Outcome:
    id = submitted(instance, options={"max_reweightings": 30})
    instance.midst(id, "reweight")
    began = time.monotonic()
    instance.jobs.queue.push(id, instance.jobs.records.get(id).attempt_id)
    job = instance.final(id)
    assert (job.status, job.attempt) == (Status.SUCCEEDED, 1), f"{status_of(job)}\n{instance.jobs.log(id)}"
    return Outcome(status_of(job), time.monotonic() - began)


def cancel_at(stage: str) -> Fault:
    """Register the fault of cancelling a job in a stage."""

    def cancel(instance: Instance) -> Outcome:
        blockers = [submitted(instance, options=LONG) for _ in range(2)] if stage == "queued" else []
        for blocker in blockers:
            instance.midst(blocker, "reweight")
        id = _in_stage(instance, stage)
        there = "queued" if stage == "queued" else instance.midst(id, stage)
        began = time.monotonic()
        job = cancelled(instance, id)
        seconds = time.monotonic() - began
        assert job.status is (Status.SUCCEEDED if there == "succeeded" else Status.CANCELLED), status_of(job)
        assert (job.artifacts == []) is (job.status is Status.CANCELLED)
        for blocker in blockers:
            cancelled(instance, blocker)
        return Outcome(status_of(job) if there == stage else f"{status_of(job)} (was {there} already)", seconds)

    cancel.__name__ = f"cancel_{stage}"
    return fault(f"cancel in stage `{stage}`")(cancel)


def _in_stage(instance: Instance, stage: str) -> str:
    """Submit a job that spends long enough in a stage to be cancelled there."""
    if stage == "cameras":
        with instance.client() as client:
            job = client.submit(face(80, 6000).tracks.points, mesh="none", options=SHORT, timeout=120)
        instance.acknowledged.append(job.id)
        return job.id
    if stage in ("queued", "reweight"):
        return submitted(instance, options=LONG)
    return submitted(instance, frames=80, points=12_000, options=LARGE)


for _stage in ("queued", "loading", "cameras", "reweight", "exporting"):
    cancel_at(_stage)


@fault("an array larger than the memory that a job may take (RLIMIT_AS)")
def memory(instance: Instance) -> Outcome:
    """Run on a separate installation with PLIANT_MEMORY_LIMIT."""
    lean = Instance(instance.folder / "lean", chosen=replace(SOON, memory_limit=700 << 20), workers=1)
    with lean:
        began = time.monotonic()
        id = submitted(lean, frames=200, points=9000, options=SHORT)
        job = lean.final(id)
        seconds = time.monotonic() - began
        assert job.error is not None
        assert (job.status, job.error.code) == (Status.FAILED, "out_of_memory"), job.error
        after = submitted(lean, frames=6, points=50, options=SHORT)
        assert lean.final(after).status is Status.SUCCEEDED
        assert lean.misfits() == []
    return Outcome(f"{status_of(job)}; the next job succeeded", seconds)

"""Outages of the store, killed supervisors and full disks: every acknowledged job is completed."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pliant.schemas.job import Status
from pliant.worker.errors import ServerFailed, StoreUnavailable
from pliant.worker.jobs.retry import retry
from pliant.worker.maintenance.fsck import findings
from pliant.worker.processes.valkey import Valkey, disk_is_full, find_binary
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.connection import connect
from worker_house import House, settled

from benchmarks.installation.instance import running

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")


@pytest.mark.slow
def test_a_job_survives_an_outage_of_the_store(tmp_path: Path, inputs_files: tuple[Path, Path]) -> None:
    settings = Settings(data=tmp_path, workers=1, threads=1, lost_after=2.0)
    with House(settings, own_valkey=True, inputs=inputs_files) as house:
        id = house.submit(long=True)
        house.solving(id)
        (job_process,) = house.job_processes()
        server = house.supervisor.pids()["valkey"]
        os.kill(server, signal.SIGSTOP)  # it neither answers nor refuses, for longer than a lease
        time.sleep(3.5)
        os.kill(server, signal.SIGCONT)
        before = house.jobs.get(id).progress
        house.until(lambda: house.jobs.get(id).progress != before, "it keeps reporting progress")
        assert (house.jobs.get(id).attempt, house.job_processes()) == (1, [job_process])
        os.kill(server, signal.SIGKILL)
        house.until(lambda: house.supervisor.pids().get("valkey", server) != server, "it is started again")
        house.until(lambda: house.jobs.get(id).progress != before, "it keeps reporting progress")
        assert (house.jobs.get(id).attempt, house.job_processes()) == (1, [job_process])
        house.jobs.cancel(id)
        assert house.final(id).status is Status.CANCELLED
        settled(house)


@pytest.mark.slow
def test_killing_valkey_loses_no_job(tmp_path: Path, inputs_files: tuple[Path, Path]) -> None:
    settings = Settings(data=tmp_path, workers=2, threads=1)
    with House(settings, own_valkey=True, inputs=inputs_files) as house:
        ids = [house.submit() for _ in range(3)]
        old = house.supervisor.pids()["valkey"]
        os.kill(old, signal.SIGKILL)
        house.until(lambda: house.supervisor.pids().get("valkey", old) != old, "it is started again")
        jobs = [house.final(id, seconds=60) for id in ids]
        assert [job.status for job in jobs] == [Status.SUCCEEDED] * 3
        assert max(job.attempt for job in jobs) <= 2
        assert len(house.jobs.page().jobs) == 3
        rest = connect(house.settings.redis, decode=True)
        house.until(lambda: rest.keys("rq:job:*") == [], "RQ keeps nothing of jobs that are done")
        rest.close()
        settled(house)


@pytest.mark.s3
def test_jobs_run_on_a_redis_with_a_password_and_on_s3(
    tmp_path: Path, s3_url: str, inputs_files: tuple[Path, Path]
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    password = secrets.token_hex(8)
    command = [str(find_binary()), "--bind", "127.0.0.1", "--port", str(port), "--requirepass", password, "--save", ""]
    server = subprocess.Popen(
        [*command, "--dir", str(tmp_path), "--loglevel", "warning", "--logfile", str(tmp_path / "log")]
    )
    settings = Settings(
        data=tmp_path, redis_url=f"redis://:{password}@127.0.0.1:{port}/3", blob_url=f"{s3_url}-{secrets.token_hex(3)}",
        threads=1,
    )  # fmt: skip
    client = connect(settings.redis, decode=True, retries=60)  # the server takes seconds to start on a busy machine
    client.ping()
    client.close()
    with House(settings, inputs=inputs_files) as house:
        job = house.final(house.submit())
        assert job.status is Status.SUCCEEDED, job.error
        for artifact in job.artifacts:
            _, blob = house.jobs.artifact(job.id, artifact.name)
            digest = hashlib.sha256()
            for chunk in blob.read():
                digest.update(chunk)
            assert (blob.size, digest.hexdigest()) == (artifact.bytes, artifact.sha256)
        for pid in house.supervisor.pids().values():
            assert password.encode() not in Path(f"/proc/{pid}/cmdline").read_bytes(), "anybody may read a command line"
        assert list((tmp_path / "blobs").rglob("*")) == [], "nothing is stored on this machine"
        settled(house)
        house.jobs.delete(job.id)
        assert house.jobs.blobs.list() == []
    server.terminate()
    server.wait(10)


SUPERVISOR = """
import os
from pliant.worker.settings import Settings
from pliant.worker.processes.supervisor import Supervisor, valkey_child, worker_children
from pliant.worker.processes.valkey import Valkey

settings = Settings.from_environment()
supervisor = Supervisor([valkey_child(Valkey.claim(settings.data)), *worker_children(settings)])
supervisor.run(on_started=lambda: print(*supervisor.pids().values(), flush=True))
"""


@pytest.mark.slow
def test_killing_the_supervisor_ends_all_and_loses_no_job(tmp_path: Path, inputs_files: tuple[Path, Path]) -> None:
    settings = Settings(data=tmp_path, workers=1, threads=1, lost_after=2.0, stop_grace=1.0)
    env = {**os.environ, **settings.to_environment()}
    process = subprocess.Popen([sys.executable, "-c", SUPERVISOR], env=env, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    pids = [int(word) for word in process.stdout.readline().split()]
    with House(settings, inputs=inputs_files, children=[]) as outside:
        busy, waiting = outside.submit(long=True), outside.submit()
        outside.solving(busy)
        process.kill()
        process.wait()
        process.stdout.close()
        outside.until(lambda: not any(running(pid) for pid in pids), "all its children end")
        with pytest.raises(StoreUnavailable):
            outside.jobs.get(busy)
    with House(settings, own_valkey=True, inputs=inputs_files) as house:
        house.until(lambda: house.jobs.get(busy).attempt == 2, "the lost job begins again")
        house.jobs.cancel(busy)
        assert house.final(busy).status is Status.CANCELLED
        assert house.final(waiting).status is Status.SUCCEEDED
        settled(house)


@pytest.mark.slow
def test_a_full_disk_fails_the_job_and_the_next_one_succeeds(
    small_disk: Path, tmp_path: Path, valkey_data: Path, inputs_files: tuple[Path, Path]
) -> None:
    settings = Settings(
        data=small_disk, redis_url=Settings(data=valkey_data).redis, blob_url=(tmp_path / "blobs").as_uri(),
        queue=f"full-{secrets.token_hex(3)}", threads=1,
    )  # fmt: skip
    with House(settings, inputs=inputs_files) as house:
        filler = small_disk / "filler"
        filler.write_bytes(b"x" * (3 * 1024 * 1024 - 40 * 1024))
        job = house.final(house.submit())
        assert job.error is not None
        assert (job.status, job.error.code, job.error.retryable) == (Status.FAILED, "storage_failed", True)
        assert "No space left on device" in job.error.detail
        filler.unlink()
        assert house.final(retry(house.jobs, job.id).id).status is Status.SUCCEEDED
        settled(house)


def test_a_full_blob_store_refuses_the_job_and_keeps_nothing(
    small_disk: Path, tmp_path: Path, valkey_data: Path, inputs_files: tuple[Path, Path]
) -> None:
    settings = Settings(
        data=tmp_path, redis_url=Settings(data=valkey_data).redis, blob_url=(small_disk / "blobs").as_uri(),
        queue=f"full-{secrets.token_hex(3)}",
    )  # fmt: skip
    with House(settings, inputs=inputs_files, children=[]) as house:
        (small_disk / "filler").write_bytes(b"x" * (3 * 1024 * 1024 - 20 * 1024))
        with pytest.raises(StoreUnavailable, match="No space left on device"):
            house.submit(long=True)
        assert house.jobs.page().jobs == []
        assert house.jobs.records.used() == 0
        assert findings(house.jobs, pause=0) == []


@pytest.mark.parametrize("reason", ["No space left on device", "Read-only file system"])
def test_a_disk_that_takes_no_files_is_not_ready(small_disk: Path, tmp_path: Path, reason: str) -> None:
    blobs, file = Blobs.open((small_disk / "blobs").as_uri()), tmp_path / "file"
    file.write_bytes(b"x" * 10_000)
    blobs.put("jobs/a", file)
    blobs.check()
    if reason.startswith("No space"):
        with pytest.raises(OSError, match=reason):
            (small_disk / "filler").write_bytes(b"x" * (4 << 20))
    else:
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for call in (blobs.check, lambda: blobs.put("jobs/b", file)):
        with pytest.raises(StoreUnavailable, match=reason):
            call()
    assert blobs.get("jobs/a").size == 10_000


def test_valkey_on_a_full_disk_refuses_jobs_and_loses_none(
    small_disk: Path, tmp_path: Path, inputs_files: tuple[Path, Path]
) -> None:
    settings = Settings(data=small_disk, blob_url=(tmp_path / "blobs").as_uri(), threads=1)
    with House(settings, own_valkey=True, inputs=inputs_files, children=[]) as house:
        accepted = [house.submit()]

        def answered(wanted: bool) -> bool:
            try:
                accepted.append(house.submit())
            except StoreUnavailable:
                return not wanted
            return wanted

        filler = small_disk / "filler"
        with filler.open("wb", buffering=0) as out, contextlib.suppress(OSError):
            while out.write(b"x" * 4096):
                pass
        house.until(lambda: answered(False), "it refuses")
        assert disk_is_full(small_disk)
        filler.unlink()
        house.until(lambda: answered(True), "it accepts again")
        assert not disk_is_full(small_disk)
        assert set(accepted) <= {job.id for job in house.jobs.page(limit=200).jobs}
        # There is no reconciler here: it would queue what is not queued, and sweep a refused submission's file hours later.
        left = findings(house.jobs, pause=0)
        assert all("belongs to no job" in each or "the queue does not hold it" in each for each in left)


def test_a_server_that_a_full_disk_keeps_from_starting_says_so(small_disk: Path) -> None:
    Valkey.claim(small_disk).release()
    with pytest.raises(OSError, match="No space left on device"):
        (small_disk / "filler").write_bytes(b"x" * (4 << 20))
    valkey = Valkey.claim(small_disk)
    try:
        with pytest.raises(
            ServerFailed, match=f"ended with code 1. The disk of {small_disk} is full: free some space."
        ):
            valkey.start()
    finally:
        valkey.release()

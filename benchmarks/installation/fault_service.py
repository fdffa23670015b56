"""Faults in the API, or in all processes at once."""

from __future__ import annotations

import hashlib
import socket
import subprocess
import sys
import tempfile
import time

from pliant.client import Job, Status
from pliant.client.multipart import Remainder
from pliant.solver.gallery import face

from benchmarks.installation.fault_list import LARGE, SHORT, Outcome, cancelled, fault, status_of, submitted
from benchmarks.installation.instance import Instance, running
from benchmarks.installation.long_jobs import LONG


@fault("kill -9 the API in mid upload")
def api_uploading(instance: Instance) -> Outcome:
    sequence = face(60, 40_000)  # 38 MB, above the SDK's threshold
    began: list[int] = []
    whole, killed = Remainder.pieces, 0.0

    def pieces(rest: Remainder):
        nonlocal killed
        began.append(rest.offset)
        for number, piece in enumerate(whole(rest)):
            if number == 100 and len(began) == 1:
                instance.kill("service")
                killed = time.monotonic()
            yield piece

    Remainder.pieces = pieces  # type: ignore[method-assign]
    try:
        with instance.client() as client:
            job = client.submit(sequence.tracks.points, mesh="none", options=LARGE, timeout=240)
    finally:
        Remainder.pieces = whole  # type: ignore[method-assign]
    seconds = time.monotonic() - killed
    instance.acknowledged.append(job.id)
    assert len(began) == 2
    assert began[1] > 10_000_000, "what had arrived was not sent again"
    cancelled(instance, job.id)
    return Outcome(f"accepted; went on at byte {began[1]:,}", seconds)


@fault("kill -9 the API in mid form (no upload)")
def api_receiving(instance: Instance) -> Outcome:
    host, port = instance.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        head = "POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: multipart/form-data; boundary=b\r\n"
        part = '--b\r\nContent-Disposition: form-data; name="tracks"; filename="t.npz"\r\n\r\n'
        connection.sendall(f"{head}Content-Length: 9000000\r\n\r\n{part}".encode() + bytes(3_000_000))
        incoming = instance.settings.data / "incoming"
        instance.until(
            lambda: any(path.is_file() and path.stat().st_size for path in incoming.glob("*/*/*")), "it arrives"
        )
        instance.kill("service")
        began = time.monotonic()
    id = submitted(instance, options=SHORT)
    assert instance.final(id).status is Status.SUCCEEDED
    assert not any(path.is_file() for path in incoming.glob("*/*/*"))
    return Outcome("nothing was acknowledged, nothing is kept", time.monotonic() - began)


@fault("kill -9 the API in mid wait and mid job")
def api_waiting(instance: Instance) -> Outcome:
    id = submitted(instance, options={"max_reweightings": 40})
    killed: list[float] = []

    def kill(_: Job) -> None:
        if not killed:
            instance.kill("service")
            killed.append(time.monotonic())

    with instance.client() as client:
        job = client.wait(id, on_progress=kill, load=False, timeout=240).job
    assert (job.status, job.attempt) == (Status.SUCCEEDED, 1)
    return Outcome(f"{status_of(job)}; the client noticed nothing", time.monotonic() - killed[0])


@fault("kill -9 the API in mid download")
def api_downloading(instance: Instance) -> Outcome:
    id = submitted(instance, frames=60, points=8000, options=LARGE)
    instance.final(id)
    killed: list[float] = []

    def kill(done: int, _: int) -> None:
        if not killed and done > 0:
            instance.kill("service")
            killed.append(time.monotonic())

    with tempfile.TemporaryDirectory() as folder, instance.client() as client:
        path = client.download(id, folder, names=["shapes.npz"], on_download=kill, timeout=240)["shapes.npz"]
        about = next(each for each in instance.jobs.get(id).artifacts if each.name == "shapes.npz")
        assert hashlib.sha256(path.read_bytes()).hexdigest() == about.sha256
    return Outcome("the file is complete and correct", time.monotonic() - killed[0])


@fault("kill -9 everything in mid solve, and start it again")
def everything(instance: Instance) -> Outcome:
    id = submitted(instance, options=LONG)
    waiting = submitted(instance, options=SHORT)
    instance.midst(id, "reweight")
    old = {pid for pids in instance.look().values() for pid in pids}
    instance.kill_all()
    began = time.monotonic()
    instance.until(lambda: not any(running(pid) for pid in old), "all of it is gone", seconds=30)
    instance.start()
    instance.until(lambda: instance.jobs.get(id).attempt >= 2, "it is begun again")
    seconds = time.monotonic() - began
    assert instance.final(waiting).status is Status.SUCCEEDED
    cancelled(instance, id)
    return Outcome("running, attempt 2 (cancelled then); the waiting one succeeded", seconds)


@fault("SIGTERM to everything in mid solve, and start it again")
def stopped(instance: Instance) -> Outcome:
    id = submitted(instance, options=LONG)
    instance.midst(id, "reweight")
    old = {pid for pids in instance.look().values() for pid in pids}
    began = time.monotonic()
    instance.stop()
    stopping = time.monotonic() - began
    assert not any(running(pid) for pid in old)
    instance.start()
    instance.until(lambda: instance.jobs.get(id).attempt >= 2, "it is begun again")
    seconds = time.monotonic() - began
    assert "sign of life" not in instance.jobs.log(id), "it was put back, not lost"
    cancelled(instance, id)
    return Outcome(f"put back within {stopping:.1f} s; running, attempt 2 (cancelled then)", seconds)


@fault("a second `pliant up` on the same data directory")
def second(instance: Instance) -> Outcome:
    id = submitted(instance, options={"max_reweightings": 30})
    began = time.monotonic()
    command = [sys.executable, "-m", "pliant.cli", "up", "--port", "0", "--data", str(instance.settings.data)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    seconds = time.monotonic() - began
    assert (ran.returncode, "already used" in ran.stderr) == (6, True), ran.stderr
    job = instance.final(id)
    assert job.status is Status.SUCCEEDED
    return Outcome(f"refused with exit code 6; the job {status_of(job)}", seconds)

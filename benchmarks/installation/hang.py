"""Measure how long routes and status reads take while a store hangs: `python -m benchmarks.installation.hang`.

The stores are on this machine. S3 is a socket with a full connection queue, so that the kernel drops each connection attempt (dropped), or
a port without a listener (refused). Valkey is stopped with SIGSTOP (dropped).
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import httpx
import numpy as np
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.worker.jobs.service import Jobs
from pliant.worker.jobs.submission import Submission
from pliant.worker.processes.containment import die_with_parent
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings

WAITING = 50
"""Requests that wait for the hanging store while status reads are timed."""


@contextmanager
def dropping() -> Iterator[int]:
    """Yield a port that neither accepts nor refuses connections."""
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        port = int(full.getsockname()[1])
        fillers = []
        for _ in range(4):
            filler = socket.socket()
            filler.setblocking(False)
            filler.connect_ex(("127.0.0.1", port))
            fillers.append(filler)
        yield port
        for filler in fillers:
            filler.close()


def free_port() -> int:
    """Return a port without a listener."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def service(data: Path, blobs: int | None) -> Iterator[str]:
    """Run an API process; its blob store is S3 at a port, or the data directory."""
    port = free_port()
    env = {**os.environ, "PLIANT_DATA": str(data), "PLIANT_PORT": str(port), "PLIANT_LOG_LEVEL": "error"}
    if blobs is not None:
        env |= {
            "PLIANT_BLOB_URL": "s3://bucket/prefix", "AWS_ENDPOINT_URL": f"http://127.0.0.1:{blobs}", "AWS_ALLOW_HTTP": "true",
            "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_REGION": "us-east-1",
        }  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-m", "pliant.service"], env=env,
        # An interruption may come before the process is held below.
        preexec_fn=partial(die_with_parent, os.getpid(), how=signal.SIGTERM),
    )  # fmt: skip
    url = f"http://127.0.0.1:{port}"
    try:
        while True:
            try:
                httpx.get(f"{url}/healthz", timeout=5)
                break
            except httpx.TransportError:
                time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(30)


def routes(id: str) -> dict[str, tuple[str, str, dict[str, object]]]:
    """Return the requests that are timed."""
    form = {"tracks": ("tracks.npz", _npz()), "mesh": (None, "none")}
    return {
        "`GET /healthz`": ("GET", "/healthz", {}), "`GET /readyz`": ("GET", "/readyz", {}),
        "`GET /v1/jobs/{id}`": ("GET", f"/v1/jobs/{id}", {}), "`GET /v1/jobs`": ("GET", "/v1/jobs", {}),
        "`GET …/artifacts`": ("GET", f"/v1/jobs/{id}/artifacts", {}), "`POST /v1/jobs`": ("POST", "/v1/jobs", {"files": form}),
        "`POST …/retry`": ("POST", f"/v1/jobs/{id}/retry", {}),
    }  # fmt: skip


def timed(url: str, id: str) -> tuple[dict[str, str], str]:
    """Return seconds and status of each route, and median and maximum of status reads while other requests wait for the store."""
    answers = {}
    for name, (method, path, more) in routes(id).items():
        began = time.monotonic()
        status = httpx.request(method, url + path, timeout=60, **more).status_code  # type: ignore[arg-type]
        answers[name] = f"{status} in {time.monotonic() - began:.2f} s"
    waiting = [threading.Thread(target=lambda: httpx.get(f"{url}/readyz", timeout=60)) for _ in range(WAITING)]
    for each in waiting:
        each.start()
    time.sleep(0.5)
    spent = []
    with httpx.Client(timeout=60) as client:
        until = time.monotonic() + 5
        while time.monotonic() < until:
            began = time.monotonic()
            client.get(f"{url}/v1/jobs/{id}")
            spent.append(1000 * (time.monotonic() - began))
    for each in waiting:
        each.join()
    return answers, f"{statistics.median(spent):.0f} / {max(spent):.0f} ms of {len(spent)}"


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the started processes end, too
    columns: dict[str, tuple[dict[str, str], str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        valkey = Valkey.claim(data)
        server = valkey.start()
        try:
            id = _failed(Settings(data=data))
            with dropping() as port, service(data, port) as url:
                columns["S3 dropped"] = timed(url, id)
            with service(data, free_port()) as url:
                columns["S3 refused"] = timed(url, id)
            with service(data, None) as url:
                httpx.get(f"{url}/v1/jobs/{id}", timeout=10)
                server.send_signal(signal.SIGSTOP)
                columns["Redis dropped"] = timed(url, id)
                server.send_signal(signal.SIGCONT)
        finally:
            server.send_signal(signal.SIGCONT)
            server.terminate()
            server.wait(20)
            valkey.release()
    print(f"| route | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for name in routes(id):
        print(f"| {name} | {' | '.join(answers[name] for answers, _ in columns.values())} |")
    print(
        f"| status reads with {WAITING} requests waiting, median / largest | {' | '.join(p99 for _, p99 in columns.values())} |"
    )


def _failed(settings: Settings) -> str:
    """Submit and cancel a job, so that it can be retried; return its id."""
    jobs = Jobs.open(settings)
    stated = Interpretation(
        num_frames=4, num_points=4, num_faces=0, hidden_fraction=0, mesh_source="none", has_ground_truth=False,
        has_rotations=False, layout="",
    )  # fmt: skip
    with tempfile.NamedTemporaryFile() as file:
        file.write(b"x")
        file.flush()
        id = jobs.submit(Path(file.name), Submission(options=Options()), interpretation=stated)[0].id
    jobs.cancel(id)
    return id


def _npz() -> bytes:
    with tempfile.TemporaryFile() as file:
        np.savez(file, tracks=np.random.default_rng(0).normal(size=(6, 12, 2)) * 100)
        file.seek(0)
        return file.read()


if __name__ == "__main__":
    main()

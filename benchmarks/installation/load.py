"""Load tests on a real installation with two workers: many small jobs, many pollers, one large upload.

    python -m benchmarks.installation.load [jobs] [pollers] [upload]

Prints a table for each. Exits with 1 if a request got no response or the wrong one, if the upload raised the API's memory by over 100 MB,
or if the stores are inconsistent.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread

import httpx
import numpy as np
from pliant.client import AsyncClient, Status
from pliant.client.multipart import RESUMABLE_BYTES
from pliant.solver.gallery import face
from pliant.worker.errors import NotAllowedNow

from benchmarks.installation.instance import Instance, children, resident

UNLIMITED = {"PLIANT_REQUESTS_PER_MINUTE": "0", "PLIANT_MAX_QUEUED": "0"}
MB = 2**20


def percentiles(seconds: list[float]) -> str:
    """Return median, 99th percentile and maximum in milliseconds, as text."""
    p50, p99 = np.percentile(seconds, [50, 99])
    return f"{1000 * p50:.0f} / {1000 * p99:.0f} / {1000 * max(seconds):.0f}"


@contextmanager
def watched(pid: int) -> Iterator[Callable[[], float]]:
    """Sample a process's memory; yield a function that returns the maximum so far, in MB."""
    largest, ended = [resident(pid)], Event()

    def sample() -> None:
        while not ended.wait(0.02):
            largest.append(max(largest[-1], resident(pid)))

    thread = Thread(target=sample)
    thread.start()
    try:
        yield lambda: largest[-1] / MB
    finally:
        ended.set()
        thread.join()


def jobs(instance: Instance, *, number: int, clients: int) -> int:
    """Submit small jobs from many clients and wait for each, while another client polls a job's status; return the number lost."""
    sequence = face(20, 200)  # cameras are given: this measures the handling of jobs, not the solver
    submits: list[float] = []
    reads: list[float] = []
    ends: list[Status] = []
    left = iter(range(number))

    async def work(client: AsyncClient) -> None:
        for _ in left:
            began = time.monotonic()
            job = await client.submit(
                sequence.tracks.points, mesh="none", rotations=sequence.rotations, options={"max_reweightings": 3}
            )
            submits.append(time.monotonic() - began)
            instance.acknowledged.append(job.id)
            ends.append((await job.wait(load=False, timeout=600)).job.status)

    async def read(http: httpx.AsyncClient) -> None:
        while len(ends) < number:
            if instance.acknowledged:
                began = time.monotonic()
                answer = await http.get(f"/v1/jobs/{instance.acknowledged[-1]}")
                assert answer.status_code == 200, answer.text
                reads.append(time.monotonic() - began)
            await asyncio.sleep(0.02)

    async def everything() -> None:
        async with httpx.AsyncClient(base_url=instance.url, timeout=60) as http:
            each = [AsyncClient(instance.url) for _ in range(clients)]
            await asyncio.gather(read(http), *(work(client) for client in each))
            for client in each:
                await client.close()

    (service,) = instance.look()["service"]
    began = time.monotonic()
    with watched(service) as largest:
        asyncio.run(everything())
    seconds = time.monotonic() - began
    lost = number - ends.count(Status.SUCCEEDED)
    print(f"| {number} jobs of 20 × 200, {clients} clients, {instance.workers} workers | |\n|---|---|")
    print(f"| seconds, jobs a second | {seconds:.1f}, {number / seconds:.1f} |")
    print(f"| submissions, ms: median / p99 / largest | {percentiles(submits)} |")
    print(f"| status reads meanwhile ({len(reads)}), ms | {percentiles(reads)} |")
    print(f"| API memory at most | {largest():.0f} MB |")
    print(f"| lost | {lost} |\n")
    return lost


class Poller:
    """One persistent connection: a thousand in one httpx pool would cost more than the service."""

    def __init__(self, url: str) -> None:
        self._host, port = url.removeprefix("http://").split(":")
        self._port = int(port)
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def get(self, path: str, headers: dict[str, str]) -> int:
        """Send a GET, read the response, return its status."""
        if self._streams is None:
            self._streams = await asyncio.open_connection(self._host, self._port)
        reader, writer = self._streams
        lines = [f"GET {path} HTTP/1.1", f"Host: {self._host}:{self._port}", *(f"{k}: {v}" for k, v in headers.items())]
        writer.write("\r\n".join([*lines, "", ""]).encode())
        head = (await reader.readuntil(b"\r\n\r\n")).decode().lower()
        await reader.readexactly(int(head.split("content-length: ")[1].split("\r\n")[0]))
        return int(head.split()[1])

    def close(self) -> None:
        """Close the connection."""
        if self._streams is not None:
            self._streams[1].close()


def pollers(instance: Instance, *, number: int, seconds: float, every: float) -> int:
    """Poll jobs from many clients, then let all wait for one job at once (`Prefer: wait`); return the number of lost requests."""
    ids = instance.acknowledged or [one_job(instance)]
    reads: list[float] = []
    lost: list[str] = []

    async def ask(poller: Poller, path: str, wait: int | None = None) -> None:
        began = time.monotonic()
        try:
            status = await poller.get(path, {} if wait is None else {"Prefer": f"wait={wait}"})
            if status != 200:
                lost.append(str(status))
        except (OSError, EOFError) as fault:
            lost.append(type(fault).__name__)
        reads.append(time.monotonic() - began)

    async def poll(poller: Poller, index: int, until: float) -> None:
        await asyncio.sleep(every * index / number)
        while time.monotonic() < until:
            await ask(poller, f"/v1/jobs/{ids[index % len(ids)]}")
            await asyncio.sleep(every)

    async def all_of_them(one: Callable[[Poller, int], Awaitable[None]]) -> None:
        each = [Poller(instance.url) for _ in range(number)]
        await asyncio.gather(*(one(poller, index) for index, poller in enumerate(each)))
        for poller in each:
            poller.close()

    (service,) = instance.look()["service"]
    with watched(service) as largest:
        until = time.monotonic() + seconds
        asyncio.run(all_of_them(lambda poller, index: poll(poller, index, until)))
        print(f"| {number} pollers | |\n|---|---|")
        print(
            f"| each every {every:g} s for {seconds:g} s: reads, a second | {len(reads)}, {len(reads) / seconds:.0f} |"
        )
        print(f"| status reads, ms: median / p99 / largest | {percentiles(reads)} |")
        reads.clear()
        long = one_job(instance, options={"max_reweightings": 1000, "tolerance": 1e-15}, frames=40, points=1200)
        began = time.monotonic()
        asyncio.run(all_of_them(lambda poller, _: ask(poller, f"/v1/jobs/{long}", wait=15)))
        print(f"| all waiting for one job, `Prefer: wait=15`: all answered after | {time.monotonic() - began:.1f} s |")
        with suppress(NotAllowedNow):
            instance.jobs.cancel(long)
        instance.final(long)
    print(f"| API memory at most | {largest():.0f} MB |")
    print(f"| lost | {len(lost)}{' ' + str(sorted(set(lost))) if lost else ''} |\n")
    return len(lost)


def upload(instance: Instance, *, size: int) -> int:
    """Upload a large file with the SDK; return 1 if the API's memory grew by over 100 MB until the job was accepted."""
    frames, points = 100, size * MB // (100 * 2 * 8)
    tracks = np.random.default_rng(0).normal(size=(frames, points, 2))
    assert tracks.nbytes > RESUMABLE_BYTES
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tracks.npz"
        np.savez(path, tracks=tracks)
        del tracks
        instance.client().limits()
        (service,) = instance.look()["service"]
        before = resident(service) / MB
        apart: list[float] = []
        moments: dict[str, float] = {}

        with watched(service) as largest, instance.client() as client, _children_of(service, apart):
            began = time.monotonic()

            def report_progress(done: int, _: int) -> None:
                if done >= path.stat().st_size and "sent" not in moments:
                    moments.update(sent=time.monotonic() - began, memory=largest())

            job = client.submit(
                path, mesh="none", options={"method": "pseudo_inverse"}, on_upload=report_progress, timeout=600
            )
            accepted = time.monotonic() - began
            instance.acknowledged.append(job.id)
            client.cancel(job.id)
            peak = largest()
    instance.final(job.id)
    rate = size / moments["sent"]
    print(f"| {size} MB of tracks ({frames} × {points:,}), by the SDK | |\n|---|---|")
    print(f"| sent in, MB a second | {moments['sent']:.1f} s, {rate:.0f} |")
    print(f"| accepted (read, checked, stored) after | {accepted:.1f} s |")
    memory = f"{before:.0f} / {moments['memory']:.0f} / {peak:.0f} MB"
    print(f"| API memory before / at most while it arrives / at most until accepted | {memory} |")
    print(f"| the process that reads it, at most | {max(apart, default=0):.0f} MB |")
    print("| lost | 0 |\n")
    return int(peak - before > 100)


@contextmanager
def _children_of(pid: int, largest: list[float]) -> Iterator[None]:
    """Record the memory of a process's children, in MB."""
    ended = Event()

    def sample() -> None:
        while not ended.wait(0.05):
            for child in children(pid):
                try:
                    largest.append(resident(child) / MB)
                except OSError:
                    continue

    thread = Thread(target=sample)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def one_job(
    instance: Instance, *, options: dict[str, object] | None = None, frames: int = 20, points: int = 200
) -> str:
    """Submit a job whose cameras are known; return its id."""
    with instance.client() as client:
        sequence = face(frames, points)
        job = client.submit(
            sequence.tracks.points,
            mesh="none",
            rotations=sequence.rotations,
            options=options or {"max_reweightings": 5},
        )
    instance.acknowledged.append(job.id)
    return job.id


def main() -> int:
    """Run the selected loads; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("loads", nargs="*", default=["jobs", "pollers", "upload"], help="jobs, pollers, upload")
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--pollers", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=10.0, help="seconds between two looks of one poller")
    parser.add_argument("--megabytes", type=int, default=300)
    given = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as folder, Instance(Path(folder), of_service=UNLIMITED) as instance:
        for load in given.loads:
            if load == "jobs":
                wrong += jobs(instance, number=given.jobs, clients=given.clients)
            elif load == "pollers":
                wrong += pollers(instance, number=given.pollers, seconds=given.seconds, every=given.every)
            else:
                wrong += upload(instance, size=given.megabytes)
        misfits = instance.misfits()
        print("fsck: " + (" ".join(misfits) or "the stores are consistent with the job records"))
    return 1 if wrong or misfits else 0


if __name__ == "__main__":
    sys.exit(main())

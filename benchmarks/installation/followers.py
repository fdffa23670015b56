"""Let many clients follow the events of one job, while a separate process polls its status.

python -m benchmarks.installation.loops
"""

from __future__ import annotations

import asyncio
import http.client
import multiprocessing
import time
from contextlib import suppress
from multiprocessing.synchronize import Event

from pliant.worker.errors import NotAllowedNow

from benchmarks.installation.instance import Instance
from benchmarks.installation.load import percentiles, watched
from benchmarks.installation.long_jobs import LONG, long_sequence

PAUSE = 0.02
"""Seconds between two status reads."""

WITHIN = 60.0
"""Time limit for all followers to connect, and for all streams to end after the job, s."""


def read_statuses(
    host: str, port: int, path: str, started: Event, ended: Event, results: multiprocessing.Queue[list[float]]
) -> None:
    """Poll a job's status until `ended`, and put the seconds of each read into `results`."""
    spent: list[float] = []
    connection = http.client.HTTPConnection(host, port, timeout=60)
    while not ended.is_set():
        began = time.monotonic()
        connection.request("GET", path)
        answer = connection.getresponse()
        answer.read()
        assert answer.status == 200, answer.status
        spent.append(time.monotonic() - began)
        started.set()
        time.sleep(PAUSE)
    connection.close()
    results.put(spent)


async def follow(host: str, port: int, path: str, connected: asyncio.Semaphore) -> tuple[int, bool]:
    """Read a stream to its end; return the number of events and whether the last one was final."""
    reader, writer = await asyncio.open_connection(host, port)
    writer.write(f"GET {path}/events HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
    head = await reader.readuntil(b"\r\n\r\n")
    assert b" 200 " in head.split(b"\r\n")[0], head
    connected.release()
    events, final = 0, False
    while line := await reader.readline():
        events += line.startswith(b"event:")
        final = final or (line.startswith(b"data:") and b'"status":"cancelled"' in line.replace(b" ", b""))
        if line.strip() == b"0":  # the last chunk
            break
    writer.close()
    return events, final


def followers(instance: Instance, *, number: int, seconds: float) -> int:
    """Let many clients follow one job, print a table, and return the number of lost streams."""
    sequence = long_sequence()
    with instance.client() as client:
        long = client.submit(sequence.tracks.points, mesh="none", rotations=sequence.rotations, options=LONG).id
    instance.acknowledged.append(long)
    instance.until(lambda: instance.jobs.get(long).progress is not None, "it is solved")
    host, _, port = instance.url.removeprefix("http://").partition(":")
    path = f"/v1/jobs/{long}"
    context = multiprocessing.get_context("spawn")
    started, ended, results = context.Event(), context.Event(), context.Queue()

    async def everything() -> list[tuple[int, bool] | BaseException]:
        connected = asyncio.Semaphore(0)
        tasks = [asyncio.create_task(follow(host, int(port), path, connected)) for _ in range(number)]
        for _ in tasks:
            await asyncio.wait_for(connected.acquire(), WITHIN)
        reader = context.Process(target=read_statuses, args=(host, int(port), path, started, ended, results))
        reader.start()
        assert await asyncio.to_thread(started.wait, WITHIN)
        await asyncio.sleep(seconds)
        ended.set()
        with suppress(NotAllowedNow):
            await asyncio.to_thread(instance.jobs.cancel, long)
        return await asyncio.wait_for(asyncio.gather(*tasks, return_exceptions=True), WITHIN)

    (service,) = instance.look()["service"]
    with watched(service) as largest:
        streams = asyncio.run(everything())
    spent = results.get(timeout=30)
    instance.final(long)
    ends = [each for each in streams if not isinstance(each, BaseException)]
    lost = number - sum(final for _, final in ends)
    print(f"| {number} followers of one job for {seconds:g} s | |\n|---|---|")
    print(f"| events received by each: least / most | {min(n for n, _ in ends)} / {max(n for n, _ in ends)} |")
    print(f"| {number} followers: status reads, ms: median / p99 / largest | {percentiles(spent)} of {len(spent)} |")
    print(f"| {number} followers: API memory at most | {largest():.0f} MB |")
    print(f"| {number} followers: streams lost | {lost} |\n")
    return lost

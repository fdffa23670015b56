"""Following a job: parsing at any chunk boundary, and streams that break."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Iterator
from itertools import pairwise

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pliant.client import AsyncClient, Client, Retry, Status, UnexpectedAnswer, WaitTimeout
from pliant.client.events import Message, Parser
from pliant.service.testing import InMemoryService

QUICK = Retry(shortest_pause=0.001, longest_pause=0.001, poll_interval=0.005)
POINTS = np.random.default_rng(1).normal(size=(4, 9, 2))


def messages(data: bytes, cuts: list[int]) -> list[Message]:
    parser, found, edges = Parser(), [], sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    for begin, end in pairwise(edges):
        found += parser.feed(data[begin:end])
    return found


@given(cuts=st.lists(st.integers(0, 10_000)), newline=st.sampled_from(["\n", "\r\n", "\r"]))
def test_messages_do_not_depend_on_chunk_boundaries(cuts: list[int], newline: str) -> None:
    text = 'retry: 2000\n\nid: 7\nevent: job\ndata: {"naïve": 1}\n\n: still here\n\ndata: two\ndata:lines\n\nid: 8\nevent: x\n\n'
    found = messages((text + "end: 1\n").replace("\n", newline).encode(), cuts)
    assert found == [Message("7", "job", '{"naïve": 1}'), Message("7", "message", "two\nlines")]


class Breaking(httpx.SyncByteStream):
    def __init__(self, data: bytes) -> None:
        self.data = data

    def __iter__(self) -> Iterator[bytes]:
        yield self.data
        raise httpx.ReadError("connection reset by peer")


class Shaky(InMemoryService):
    """Breaks off every stream after one and a half events."""

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        answer = super().handle_request(request)
        if not request.url.path.endswith("/events"):
            return answer
        data = b""
        for piece in answer.iter_raw():
            data += piece
            if b"\n\n" in data.partition(b"data: ")[2]:
                break
        answer.close()
        cut = data[: data.index(b"\n\n", data.index(b"data: ")) + 2] + b'event: job\ndata: {"id'
        return httpx.Response(200, stream=Breaking(cut), headers={"Content-Type": "text/event-stream"})


def test_events_end_with_the_final_record_and_never_repeat() -> None:
    with Client("http://pliant.test", transport=InMemoryService(steps=5), retries=QUICK) as client:
        job = client.submit(POINTS)
        seen = list(job.events())
        assert seen[-1].status is Status.SUCCEEDED
        assert job.record == seen[-1]
        assert list(dict.fromkeys(each.status for each in seen)) == ["queued", "running", "succeeded"]
        fractions = [each.progress.fraction for each in seen if each.progress is not None]
        assert fractions == sorted(fractions)


def test_an_interrupted_stream_resumes_after_the_last_event() -> None:
    service = Shaky(steps=4)
    with Client("http://pliant.test", transport=service, retries=QUICK) as client:
        updates = []
        result = client.submit(POINTS).wait(on_progress=updates.append, timeout=30)
    assert result.job.status is Status.SUCCEEDED
    assert updates[-1].status is Status.SUCCEEDED
    streams = [request for request in service.requests if request.url.path.endswith("/events")]
    assert "last-event-id" not in streams[0].headers
    assert all("last-event-id" in request.headers for request in streams[1:])


def test_progress_events_change_only_the_progress() -> None:
    class Late(InMemoryService):
        """Streams only the latest progress; the record has to be requested."""

        streams = 0

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if not request.url.path.endswith("/events"):
                return super().handle_request(request)
            self.streams += 1
            progress = json.dumps({"stage": "reweight", "fraction": 0.75, "updated_at": "2030-01-01T00:00:00Z"})
            line = f"id: {self.streams}\nevent: progress\ndata: {progress}\n\n"
            return httpx.Response(200, content=line, headers={"Content-Type": "text/event-stream"})

    service = Late(steps=4)
    with Client("http://pliant.test", transport=service, retries=QUICK) as client:
        seen = list(client.submit(POINTS).events())
    assert 0.75 in [each.progress.fraction for each in seen if each.progress is not None]
    assert {each.id for each in seen} == {seen[0].id}
    assert seen[-1].status is Status.SUCCEEDED


@pytest.mark.parametrize(
    ("kind", "content", "words"),
    [
        ("text/html", "<p>", "Expected text/event-stream, got text/html"),
        ("text/event-stream", "event: job\ndata: {}\n\n", "cannot be read"),
    ],
)
def test_an_invalid_event_stream_is_an_error(kind: str, content: str, words: str) -> None:
    class Odd(InMemoryService):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if request.url.path.endswith("/events"):
                return httpx.Response(200, content=content, headers={"Content-Type": kind})
            return super().handle_request(request)

    with Client("http://pliant.test", transport=Odd(), retries=QUICK) as client:
        job = client.submit(POINTS)
        with pytest.raises(UnexpectedAnswer, match=words):
            list(job.events())


def test_following_ends_with_the_timeout() -> None:
    with Client("http://pliant.test", transport=InMemoryService(steps=math.inf), retries=QUICK) as client:
        job = client.submit(POINTS)
        with pytest.raises(WaitTimeout):
            list(job.events(timeout=0.2))


def test_the_timeout_also_ends_a_stream_without_events() -> None:
    class Heartbeats(httpx.SyncByteStream):
        def __iter__(self) -> Iterator[bytes]:
            while True:
                yield b": heartbeat\n\n"

    class Silent(InMemoryService):
        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if request.url.path.endswith("/events"):
                return httpx.Response(200, stream=Heartbeats(), headers={"Content-Type": "text/event-stream"})
            return super().handle_request(request)

    with Client("http://pliant.test", transport=Silent(steps=math.inf), retries=QUICK) as client:
        job = client.submit(POINTS)
        with pytest.raises(WaitTimeout):
            list(job.events(timeout=0.1))


def test_the_asynchronous_client_follows_too() -> None:
    async def use() -> list[Status]:
        async with AsyncClient("http://pliant.test", transport=InMemoryService(steps=3), retries=QUICK) as client:
            job = await client.submit(POINTS)
            seen = list(dict.fromkeys([now.status async for now in job.events()]))
            updates: list[Status] = []
            await job.wait(on_progress=lambda now: updates.append(now.status))
            assert updates[-1] is Status.SUCCEEDED
            return seen

    assert asyncio.run(use()) == ["queued", "running", "succeeded"]

"""Following a job: messages however the bytes are cut, streams however they break."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from itertools import pairwise

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pliant.client import AsyncClient, Client, Policy, Status, TimeIsUp, UnexpectedAnswer
from pliant.client.events import Message, Parser
from pliant.client.testing import FakeService

QUICK = Policy(shortest_pause=0.001, longest_pause=0.001, poll_interval=0.005)
POINTS = np.random.default_rng(1).normal(size=(4, 9, 2))


def messages(data: bytes, cuts: list[int]) -> list[Message]:
    parser, found, edges = Parser(), [], sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    for begin, end in pairwise(edges):
        found += parser.feed(data[begin:end])
    return found


@given(cuts=st.lists(st.integers(0, 10_000)), newline=st.sampled_from(["\n", "\r\n", "\r"]))
def test_messages_do_not_depend_on_how_the_bytes_are_cut(cuts: list[int], newline: str) -> None:
    text = 'retry: 2000\n\nid: 7\nevent: job\ndata: {"naïve": 1}\n\n: still here\n\ndata: two\ndata:lines\n\nid: 8\nevent: x\n\n'
    found = messages((text + "end: 1\n").replace("\n", newline).encode(), cuts)
    assert found == [Message("7", "job", '{"naïve": 1}'), Message("7", "message", "two\nlines")]


class Breaking(httpx.SyncByteStream):
    def __init__(self, data: bytes) -> None:
        self.data = data

    def __iter__(self) -> Iterator[bytes]:
        yield self.data
        raise httpx.ReadError("connection reset by peer")


class Shaky(FakeService):
    """Breaks every stream off after one event and a half."""

    def _answer(self, request: httpx.Request) -> httpx.Response:
        answer = super()._answer(request)
        if not request.url.path.endswith("/events"):
            return answer
        whole = answer.content.split(b"\n\n")
        cut = whole[0] + b"\n\n" + (whole[1][:30] if len(whole) > 1 else b"")
        return httpx.Response(200, stream=Breaking(cut), headers={"Content-Type": "text/event-stream"})


def test_events_end_with_the_final_record_and_never_go_back() -> None:
    with Client("http://pliant.test", transport=FakeService(looks=5), policy=QUICK) as client:
        job = client.submit(POINTS)
        seen = list(job.events())
        assert seen[-1].status is Status.SUCCEEDED
        assert job.record == seen[-1]
        assert [each.status for each in seen] == ["queued", *["running"] * 5, "succeeded"]
        fractions = [each.progress.fraction for each in seen if each.progress is not None]
        assert fractions == sorted(fractions)


def test_a_stream_that_breaks_is_taken_up_from_the_last_event() -> None:
    service = Shaky(looks=4)
    with Client("http://pliant.test", transport=service, policy=QUICK) as client:
        told = []
        result = client.submit(POINTS).wait(on_progress=told.append, timeout=30)
    assert result.job.status is Status.SUCCEEDED
    assert told[-1].status is Status.SUCCEEDED
    streams = [request for request in service.requests if request.url.path.endswith("/events")]
    assert "last-event-id" not in streams[0].headers
    assert all("last-event-id" in request.headers for request in streams[1:])


def test_progress_events_change_the_progress_alone() -> None:
    class Late(FakeService):
        """Keeps no event but the latest progress; the record has to be asked for."""

        streams = 0

        def _answer(self, request: httpx.Request) -> httpx.Response:
            if not request.url.path.endswith("/events"):
                return super()._answer(request)
            self.streams += 1
            (entry,) = self._ledger.newest_first()
            self._ledger.look(entry)
            progress = json.dumps({**json.loads(entry.job.progress.model_dump_json()), "fraction": 0.75})
            line = f"id: {self.streams}\nevent: progress\ndata: {progress}\n\n"
            return httpx.Response(200, content=line, headers={"Content-Type": "text/event-stream"})

    service = Late(looks=4)
    with Client("http://pliant.test", transport=service, policy=QUICK) as client:
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
def test_what_is_no_stream_of_events_is_named(kind: str, content: str, words: str) -> None:
    class Odd(FakeService):
        def _answer(self, request: httpx.Request) -> httpx.Response:
            if request.url.path.endswith("/events"):
                return httpx.Response(200, content=content, headers={"Content-Type": kind})
            return super()._answer(request)

    with Client("http://pliant.test", transport=Odd(), policy=QUICK) as client:
        job = client.submit(POINTS)
        with pytest.raises(UnexpectedAnswer, match=words):
            list(job.events())


def test_following_ends_with_the_timeout() -> None:
    with Client("http://pliant.test", transport=FakeService(looks=float("inf")), policy=QUICK) as client:
        job = client.submit(POINTS)
        with pytest.raises(TimeIsUp):
            list(job.events(timeout=0.2))


def test_the_asynchronous_client_follows_too() -> None:
    async def use() -> list[Status]:
        async with AsyncClient("http://pliant.test", transport=FakeService(looks=3), policy=QUICK) as client:
            job = await client.submit(POINTS)
            seen = [now.status async for now in job.events()]
            told: list[Status] = []
            await job.wait(on_progress=lambda now: told.append(now.status))
            assert told[-1] is Status.SUCCEEDED
            return seen

    assert asyncio.run(use()) == ["queued", "running", "running", "running", "succeeded"]

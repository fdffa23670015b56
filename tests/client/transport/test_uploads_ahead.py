"""Large inputs are uploaded before their job, and interrupted uploads resume."""

from __future__ import annotations

import asyncio
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pliant.client import AsyncClient, Client, InvalidRequest, NotAllowedNow, Retry, Unreachable
from pliant.client.multipart import Remainder
from pliant.service.testing import InMemoryService

PATIENT = Retry(shortest_pause=0.01, longest_pause=0.05)
PROBLEM = {
    "type": "t",
    "title": "Slow down",
    "status": 429,
    "detail": "Slow down.",
    "code": "too_many_requests",
    "retryable": True,
}
POINTS = np.random.default_rng(0).normal(size=(6, 15_000, 2))


@pytest.fixture(autouse=True)
def small_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.client.multipart.RESUMABLE_BYTES", 100_000)
    monkeypatch.setattr("pliant.client.multipart.SMALL", 10_000)
    monkeypatch.setattr("pliant.client.multipart.PIECE", 1 << 17)


@pytest.fixture
def breaking(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], list[int]]:
    """Break the connection `times` times, each `after` pieces of the body; return the offset where each attempt began."""

    def arm(times: int, after: int) -> list[int]:
        began: list[int] = []
        whole = Remainder.pieces

        def pieces(self: Remainder) -> Iterator[bytes]:
            began.append(self.offset)
            for number, piece in enumerate(whole(self)):
                if number == after and len(began) <= times:
                    raise httpx.WriteError("the cable was pulled")
                yield piece

        monkeypatch.setattr(Remainder, "pieces", pieces)
        return began

    return arm


def submit(kind: str, *args: Any, url: str, **kwargs: Any) -> Any:
    if kind == "sync":
        with Client(url, retries=PATIENT) as client:
            return client.submit(*args, **kwargs)

    async def run() -> Any:
        async with AsyncClient(url, retries=PATIENT) as client:
            return await client.submit(*args, **kwargs)

    return asyncio.run(run())


@pytest.mark.parametrize("kind", ["sync", "async"])
def test_an_interrupted_upload_resumes(kind: str, service_url: str, breaking: Callable[[int, int], list[int]]) -> None:
    began = breaking(3, 2)
    updates: list[int] = []
    job = submit(kind, POINTS, url=service_url, mesh="none", on_upload=lambda done, _: updates.append(done))
    assert job.record.interpretation.num_points == 15_000
    assert began[0] == 0
    assert len(began) >= 4
    assert sorted(began) == began, "no try began before the one before it"
    assert began[-1] > 0
    assert updates[-1] == max(updates) > POINTS.nbytes
    with Client(service_url) as client, suppress(NotAllowedNow):  # it may be done already
        client.cancel(job.id)


def test_bytes_sent_by_an_earlier_run_are_not_sent_again(
    service_url: str, breaking: Callable[[int, int], list[int]]
) -> None:
    began = breaking(10**6, 2)
    hasty = Retry(patience=0.2, first_contact=0.2, shortest_pause=0.3, jitter=lambda: 1.0)
    asked: list[httpx.Request] = []
    with (
        Client(service_url, retries=hasty, event_hooks={"request": [asked.append]}) as client,
        pytest.raises(Unreachable, match="cable"),
    ):
        client.submit(POINTS, job_id="second-run", mesh="none")
    first = len(began)
    (address,) = {request.url for request in asked if "/uploads/" in request.url.path}
    # A busy service may not have noticed the broken connection yet, and stores what it received only then; before that, it may not even
    # know the upload.
    until = time.monotonic() + 20
    while int(httpx.head(address).headers.get("Upload-Offset", "0")) == 0 and time.monotonic() < until:
        time.sleep(0.05)
    whole = breaking(0, 0)
    with Client(service_url, retries=PATIENT) as client:
        job = client.submit(POINTS, job_id="second-run", mesh="none")
        with suppress(NotAllowedNow):
            job.cancel()
    assert first >= 1
    assert whole[0] > 0, "it goes on where the first run was given up"


def test_an_expired_upload_is_sent_again() -> None:
    class Forgetful(InMemoryService):
        forgets = 1

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if request.url.path == "/v1/jobs" and self.forgets > 0:
                self.forgets -= 1
                shutil.rmtree(self.folder / "uploads")
            return super().handle_request(request)

    once = Forgetful()
    assert (
        Client("http://pliant.test", transport=once).submit(POINTS, mesh="none").record.interpretation.num_points
        == 15_000
    )
    assert [request.method for request in once.requests] == ["GET", "PUT", "POST", "GET", "PUT", "POST", "DELETE"]
    assert not [path for path in (once.folder / "uploads").rglob("*") if path.is_file()]
    always = Forgetful()
    always.forgets = 10
    with pytest.raises(InvalidRequest) as caught:
        Client("http://pliant.test", transport=always).submit(POINTS, mesh="none")
    assert caught.value.code == "unknown_upload"


def test_a_job_is_returned_if_the_deadline_passes_with_the_response() -> None:
    now = 0.0

    class Late(InMemoryService):
        """Its response to the submission arrives at the deadline."""

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            nonlocal now
            answer = super().handle_request(request)
            if request.url.path == "/v1/jobs":
                answer.read()
                now = 10.0
            return answer

    service = Late()
    with Client("http://pliant.test", transport=service, retries=Retry(clock=lambda: now)) as client:
        assert client.submit(POINTS, mesh="none", timeout=10).record.interpretation.num_points == 15_000
    assert [request.method for request in service.requests] == ["GET", "PUT", "POST"], "the upload is left to expire"


def test_after_an_offset_mismatch_the_offset_is_read_again(tmp_path: Path) -> None:
    class Jumping(InMemoryService):
        """Another client has written part of the upload in the meantime."""

        jumped = False

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if not self.jumped and request.method == "PUT":
                self.jumped = True
                half = request.read()[: len(request.content) // 2]
                headers = {name: value for name, value in request.headers.items() if name != "content-length"}
                first = httpx.Request("PUT", request.url, headers={**headers, "Upload-Complete": "?0"}, content=half)
                assert super().handle_request(first).status_code < 400
                self.requests.pop()
                request = httpx.Request("PUT", request.url, headers={"Upload-Offset": "1"}, content=b"x")
            return super().handle_request(request)

    service = Jumping()
    (tmp_path / "mesh.obj").write_text("v 0 0 0\n")
    with pytest.raises(InvalidRequest, match="expected 15000 vertices"):
        Client("http://pliant.test", transport=service, retries=PATIENT).submit(POINTS, mesh=tmp_path / "mesh.obj")
    assert [request.method for request in service.requests] == ["GET", "PUT", "GET", "PUT", "POST", "DELETE"]
    post = service.requests[-2]
    assert b'name="mesh"; filename="mesh.obj"' in post.content
    assert b'name="tracks_upload"' in post.content
    assert len(post.content) < 10_000


def test_a_rate_of_one_request_at_a_time_lets_an_upload_through() -> None:
    class Slow(InMemoryService):
        """Allows one request after each refusal, as a used up rate limit does."""

        allowed = 1

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if request.url.path.startswith("/v1/uploads/"):
                self.allowed -= 1
                if self.allowed < 0:
                    self.allowed = 1
                    return httpx.Response(
                        429, json=PROBLEM, headers={"Retry-After": "0", "Content-Type": "application/problem+json"}
                    )
            return super().handle_request(request)

    hasty = Retry(patience=3, shortest_pause=0.01, longest_pause=0.05)
    with Client("http://pliant.test", transport=Slow(), retries=hasty) as client:
        assert client.submit(POINTS, mesh="none").record.interpretation.num_points == 15_000

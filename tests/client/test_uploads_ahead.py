"""Large inputs are sent ahead of their job, in raw bytes, and gone on with where the connection broke."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pliant.client import AsyncClient, Client, InvalidRequest, NotAllowedNow, Policy, Unreachable
from pliant.client.multipart import Rest
from pliant.client.testing import FakeService

PATIENT = Policy(shortest_pause=0.01, longest_pause=0.05)
POINTS = np.random.default_rng(0).normal(size=(6, 30_000, 2))


@pytest.fixture(autouse=True)
def small_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pliant.client.upload.LARGE", 100_000)
    monkeypatch.setattr("pliant.client.upload.SMALL", 10_000)


@pytest.fixture
def breaking(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], list[int]]:
    """Break the connection while a body is being sent: so many times, each after so many pieces; tell where each began."""

    def arm(times: int, after: int) -> list[int]:
        began: list[int] = []
        whole = Rest.pieces

        def pieces(self: Rest) -> Iterator[bytes]:
            began.append(self.offset)
            for number, piece in enumerate(whole(self)):
                if number == after and len(began) <= times:
                    raise httpx.WriteError("the cable was pulled")
                yield piece

        monkeypatch.setattr(Rest, "pieces", pieces)
        return began

    return arm


def submit(kind: str, *args: Any, url: str, **kwargs: Any) -> Any:
    if kind == "sync":
        with Client(url, policy=PATIENT) as client:
            return client.submit(*args, **kwargs)

    async def run() -> Any:
        async with AsyncClient(url, policy=PATIENT) as client:
            return await client.submit(*args, **kwargs)

    return asyncio.run(run())


@pytest.mark.parametrize("kind", ["sync", "async"])
def test_a_broken_upload_goes_on_where_it_broke(
    kind: str, service_url: str, breaking: Callable[[int, int], list[int]]
) -> None:
    began = breaking(3, 2)
    told: list[int] = []
    job = submit(kind, POINTS, url=service_url, mesh="none", on_upload=lambda done, _: told.append(done))
    assert job.record.interpretation.num_points == 30_000
    assert began[0] == 0
    assert len(began) >= 4
    assert sorted(began) == began, "no try began before the one before it"
    assert began[-1] > 0
    assert told[-1] == max(told) > POINTS.nbytes
    with Client(service_url) as client, suppress(NotAllowedNow):  # it may be done already
        client.cancel(job.id)


def test_what_an_earlier_run_has_sent_is_not_sent_again(
    service_url: str, breaking: Callable[[int, int], list[int]]
) -> None:
    began = breaking(10**6, 2)
    hasty = Policy(patience=0.2, first_contact=0.2, shortest_pause=0.3, chance=lambda: 1.0)
    with Client(service_url, policy=hasty) as client, pytest.raises(Unreachable, match="cable"):
        client.submit(POINTS, job_id="second-run", mesh="none")
    first = len(began)
    whole = breaking(0, 0)
    with Client(service_url, policy=PATIENT) as client:
        job = client.submit(POINTS, job_id="second-run", mesh="none")
        with suppress(NotAllowedNow):
            job.cancel()
    assert first >= 1
    assert whole[0] > 0, "it goes on where the first run was given up"


def test_a_service_without_uploads_gets_everything_at_once() -> None:
    class Older(FakeService):
        def _route(self, request: httpx.Request) -> httpx.Response:
            return super()._route(request) if "/uploads/" not in request.url.path else self._nothing()

        def _nothing(self) -> httpx.Response:
            problem = '{"title": "Not found", "status": 404, "code": "no_such_address", "detail": "Nothing here."}'
            return httpx.Response(404, text=problem, headers={"Content-Type": "application/problem+json"})

    older = Older()
    assert Client("http://pliant.test", transport=older).submit(POINTS).record.interpretation.num_points == 30_000
    assert [request.method for request in older.requests] == ["GET", "POST"]


def test_an_upload_that_is_gone_when_the_job_comes_is_sent_again() -> None:
    class Forgetful(FakeService):
        forgets = 1

        def _route(self, request: httpx.Request) -> httpx.Response:
            if request.url.path == "/v1/jobs" and self.forgets > 0:
                self.forgets -= 1
                self.uploads.held.clear()
            return super()._route(request)

    once = Forgetful()
    assert Client("http://pliant.test", transport=once).submit(POINTS).record.interpretation.num_points == 30_000
    assert [request.method for request in once.requests] == ["GET", "PUT", "POST", "GET", "PUT", "POST", "DELETE"]
    assert once.uploads.held == {}
    always = Forgetful()
    always.forgets = 10
    with pytest.raises(InvalidRequest) as caught:
        Client("http://pliant.test", transport=always).submit(POINTS)
    assert caught.value.code == "unknown_upload"


def test_out_of_step_it_looks_again_and_small_files_go_along(tmp_path: Path) -> None:
    class Jumping(FakeService):
        """Somebody else has written part of it in the meantime."""

        jumped = False

        def _route(self, request: httpx.Request) -> httpx.Response:
            if not self.jumped and request.method == "PUT":
                self.jumped = True
                half = request.content[: len(request.content) // 2]
                name = request.url.path.rpartition("/")[2]
                self.uploads.write(name, half, {**request.headers, "upload-complete": "?0"})
                request = httpx.Request("PUT", request.url, headers={"Upload-Offset": "1"}, content=b"x")
            return super()._route(request)

    service = Jumping()
    (tmp_path / "mesh.obj").write_text("v 0 0 0\n")
    Client("http://pliant.test", transport=service, policy=PATIENT).submit(POINTS, mesh=tmp_path / "mesh.obj")
    assert [request.method for request in service.requests] == ["GET", "PUT", "GET", "PUT", "POST", "DELETE"]
    post = service.requests[-2]
    assert b'name="mesh"; filename="mesh.obj"' in post.content
    assert b'name="tracks_upload"' in post.content
    assert len(post.content) < 10_000


def test_the_double_refuses_as_the_service_does(service_url: str) -> None:
    wrong: list[tuple[str, dict[str, str], bytes]] = [
        ("HEAD-less", {"Upload-Offset": "5"}, b"x"),
        ("short", {"Upload-Length": "5"}, b"x"),
        ("other", {"Repr-Digest": "sha-256=:" + "A" * 43 + "=:"}, b"x"),
        ("part", {"Upload-Complete": "?0"}, b"half"),
        ("part", {"Upload-Offset": "3"}, b"x"),
        ("part", {"Upload-Offset": "4"}, b"x"),
        ("part", {}, b"x"),
    ]
    told = []
    for http in (
        httpx.Client(base_url=service_url),
        httpx.Client(base_url="http://pliant.test", transport=FakeService()),
    ):
        with http:
            prefix = hashlib.sha256(str(id(http)).encode()).hexdigest()[:12]
            said = []
            for name, headers, body in wrong:
                answer = http.put(f"/v1/uploads/{prefix}-{name}", headers=headers, content=body)
                said.append((answer.status_code, answer.json().get("code"), answer.json().get("offset")))
            for name in ("part", "nobody"):
                there = http.get(f"/v1/uploads/{prefix}-{name}")
                said.append((there.status_code, there.json().get("code"), there.json().get("offset")))
            half = http.put(f"/v1/uploads/{prefix}-half", headers={"Upload-Complete": "?0"}, content=b"x")
            for name in ("half", "nobody"):
                answer = http.post("/v1/jobs", files={"tracks_upload": (None, f"{prefix}-{name}")})
                said.append((answer.status_code, answer.json()["code"], answer.json()["field"]))
            assert http.delete(f"/v1/uploads/{prefix}-half").status_code == 204
            told.append([half.status_code, *said, http.delete(f"/v1/uploads/{prefix}-half").status_code])
    assert told[0] == told[1]

"""Files of any size are streamed in both directions and in both clients, without being held in memory."""

from __future__ import annotations

import asyncio
import hashlib
import tracemalloc
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import httpx
import pytest
from pliant.client import AsyncClient, Client
from pliant.client._async.download import download as async_download
from pliant.client._async.transport import Exchange as AsyncExchange
from pliant.client._sync.download import download
from pliant.client._sync.transport import Exchange
from pliant.client.retry import Attempts, Contact, Retry
from pliant.schemas.job import Artifact
from pliant.service.testing import InMemoryService
from pliant.worker.jobs.service import Jobs

SIZE = 64 * 2**20
ROOM = 4 * 2**20
"""Largest allowed Python memory for transferring the file, bytes."""

PIECE = bytes(2**16)


class Body(httpx.SyncByteStream, httpx.AsyncByteStream):
    def __iter__(self) -> Iterator[bytes]:
        for _ in range(SIZE // len(PIECE)):
            yield PIECE

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for piece in self:
            yield piece


class Sink(httpx.BaseTransport, httpx.AsyncBaseTransport):
    """Discards request bodies; answers a GET with a file and other requests with a job."""

    def __init__(self) -> None:
        self.received = 0
        self.largest = 0
        fake = Client("http://pliant.test", transport=InMemoryService())
        self.job = fake.submit([[[10 * point, point**2] for point in range(9)]] * 4).record.model_dump_json()

    def take(self, piece: bytes) -> None:
        self.received += len(piece)
        self.largest = max(self.largest, len(piece))

    def answer(self, request: httpx.Request) -> httpx.Response:
        if "/uploads/" in request.url.path:
            return self.upload(request)
        if request.method == "GET":
            return httpx.Response(200, stream=Body())
        return httpx.Response(202, text=self.job)

    def upload(self, request: httpx.Request) -> httpx.Response:
        if request.method != "GET":
            return httpx.Response(201, text="{}")
        problem = '{"title": "", "status": 404, "code": "unknown_upload", "detail": "None."}'
        return httpx.Response(404, text=problem, headers={"Content-Type": "application/problem+json"})

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        for piece in request.stream:
            self.take(piece)
        return self.answer(request)

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        async for piece in request.stream:
            self.take(piece)
        return self.answer(request)


@pytest.fixture
def memory() -> Iterator[None]:
    tracemalloc.start()
    yield
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < ROOM


@pytest.fixture(scope="module")
def big(tmp_path_factory: pytest.TempPathFactory) -> Path:
    Client("http://pliant.test", transport=Sink()).submit([[[0, 0]] * 9] * 4)  # loads what the first use imports
    path = tmp_path_factory.mktemp("big") / "tracks.npz"
    with path.open("wb") as file:
        file.truncate(SIZE)
    return path


@pytest.fixture(scope="module")
def artifact() -> Artifact:
    digest = hashlib.sha256()
    for piece in Body():
        digest.update(piece)
    return Artifact(name="big.bin", media_type="", bytes=SIZE, sha256=digest.hexdigest())


def attempts() -> Attempts:
    return Attempts(retries=Retry(), contact=Contact(url="http://127.0.0.1"))


@pytest.mark.usefixtures("memory")
def test_uploads_are_streamed(big: Path) -> None:
    sink = Sink()
    Client("http://pliant.test", transport=sink).submit(big)
    assert sink.received > SIZE
    assert sink.largest <= 2**18


@pytest.mark.usefixtures("memory")
def test_async_uploads_are_streamed(big: Path) -> None:
    sink = Sink()

    async def send() -> None:
        async with AsyncClient("http://pliant.test", transport=sink) as client:
            await client.submit(big)

    asyncio.run(send())
    assert sink.received > SIZE
    assert sink.largest <= 2**18


@pytest.mark.usefixtures("memory")
def test_downloads_are_streamed(artifact: Artifact, tmp_path: Path) -> None:
    with httpx.Client(base_url="http://pliant.test", transport=Sink()) as http:
        path = download(Exchange(http, attempts()), "/file", artifact, tmp_path, on_download=None)
    assert path.stat().st_size == SIZE


@pytest.mark.usefixtures("memory")
def test_async_downloads_are_streamed(artifact: Artifact, tmp_path: Path) -> None:
    async def fetch() -> Path:
        async with httpx.AsyncClient(base_url="http://pliant.test", transport=Sink()) as http:
            return await async_download(AsyncExchange(http, attempts()), "/file", artifact, tmp_path, on_download=None)

    assert asyncio.run(fetch()).stat().st_size == SIZE


def test_the_in_memory_service_logs_why_a_request_failed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    service = InMemoryService()

    def broken(jobs: Jobs, **options: object) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(Jobs, "page", broken)
    with httpx.Client(transport=service, base_url="http://pliant") as http:
        assert http.get("/v1/jobs").status_code == 500
    causes = [record.exc_info[1] for record in caplog.records if record.exc_info]
    assert [str(cause) for cause in causes] == ["a defect"]

"""Downloads are complete and verified, or absent."""

from __future__ import annotations

import asyncio
import hashlib
import math
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from pliant.client import AsyncClient, BadArgument, Client, CorruptDownload, Retry, Unreachable, WaitTimeout
from pliant.client.locks import lock
from pliant.service.testing import InMemoryService

QUICK = Retry(shortest_pause=0.001, longest_pause=0.001, poll_interval=0.01, patience=0.2)
POINTS = np.random.default_rng(1).normal(size=(40, 900, 2))


class Torn(httpx.SyncByteStream):
    """A body that breaks off."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def __iter__(self) -> Iterator[bytes]:
        yield self.data
        raise httpx.ReadError("connection reset by peer")


class Tearing(InMemoryService):
    """Breaks off each file after a given number of bytes, or corrupts it."""

    def __init__(self, piece: int) -> None:
        super().__init__()
        self.piece = piece
        self.changed = 0
        self.down = False

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        if self.down and "/artifacts/" in request.url.path:
            raise httpx.ConnectError("refused")
        answer = super().handle_request(request)
        if "/artifacts/" not in request.url.path:
            return answer
        answer.read()
        headers = {name: value for name, value in answer.headers.items() if name != "content-length"}
        if self.changed > 0:
            self.changed -= 1
            return httpx.Response(answer.status_code, content=answer.content[:-1] + b"?", headers=headers)
        if len(answer.content) <= self.piece:
            return httpx.Response(answer.status_code, content=answer.content, headers=headers)
        return httpx.Response(answer.status_code, stream=Torn(answer.content[: self.piece]), headers=headers)

    def fetches(self) -> list[httpx.Request]:
        return [request for request in self.requests if "/artifacts/" in request.url.path]


def finished_job(service: InMemoryService) -> tuple[Client, str, bytes]:
    client = Client("http://pliant.test", transport=service, retries=QUICK)
    job = client.submit(POINTS)
    job.wait(load=False)
    _, blob = service.jobs.artifact(job.id, "shapes.npz")
    return client, job.id, b"".join(blob.read())


def test_an_interrupted_download_resumes(tmp_path: Path) -> None:
    service = Tearing(300_000)
    client, job, data = finished_job(service)
    updates: list[tuple[int, int]] = []
    paths = client.download(job, tmp_path, names=["shapes.npz"], on_download=lambda *now: updates.append(now))
    assert paths["shapes.npz"].read_bytes() == data
    ranges = [request.headers.get("range") for request in service.fetches()]
    assert ranges == [None] + [f"bytes={n}-" for n in range(300_000, len(data), 300_000)]
    assert len({request.headers["if-range"] for request in service.fetches()[1:]}) == 1
    assert updates[-1] == (len(data), len(data))
    assert [done for done, _ in updates] == sorted(done for done, _ in updates)
    assert [path.name for path in tmp_path.iterdir()] == ["shapes.npz"]


def test_an_abandoned_download_is_resumed_by_the_next_call(tmp_path: Path) -> None:
    service = Tearing(200_000)
    client, job, data = finished_job(service)

    def fail_from_now_on(done: int, _: int) -> None:
        service.down = True

    with pytest.raises(Unreachable):
        client.download(job, tmp_path, names=["shapes.npz"], on_download=fail_from_now_on)
    assert [path.stat().st_size for path in tmp_path.iterdir()] == [200_000]
    assert not (tmp_path / "shapes.npz").exists()
    service.down = False
    client.download(job, tmp_path, names=["shapes.npz"])
    assert (tmp_path / "shapes.npz").read_bytes() == data
    assert service.fetches()[-1].headers["range"].startswith("bytes=")


def test_a_wrong_digest_is_retried_once_then_an_error(tmp_path: Path) -> None:
    service = Tearing(10**9)
    client, job, data = finished_job(service)
    service.changed = 1
    client.download(job, tmp_path, names=["shapes.npz"])
    assert (tmp_path / "shapes.npz").read_bytes() == data
    service.changed = 9
    with pytest.raises(CorruptDownload, match=r"shapes\.npz was downloaded twice and does not have the SHA-256"):
        client.download(job, tmp_path / "other", names=["shapes.npz"])
    assert list((tmp_path / "other").iterdir()) == []


def test_an_existing_file_is_not_downloaded_again(tmp_path: Path) -> None:
    service = Tearing(10**9)
    client, job, _ = finished_job(service)
    client.download(job, tmp_path)
    before = len(service.fetches())
    client.download(job, tmp_path)
    assert len(service.fetches()) == before
    (tmp_path / "shapes.npz").write_bytes(b"something else")
    client.download(job, tmp_path)
    assert len(service.fetches()) == before + 1


def test_corrupt_partial_downloads_are_replaced(tmp_path: Path) -> None:
    service = Tearing(10**9)
    client, job, data = finished_job(service)
    artifact = next(a for a in client.get(job).record.artifacts if a.name == "shapes.npz")
    part = tmp_path / f".shapes.npz.{artifact.sha256[:16]}.part"
    for rubbish in (b"x" * 1000, b"x" * len(data), b"x" * (len(data) + 9)):
        part.write_bytes(rubbish)
        client.download(job, tmp_path, names=["shapes.npz"])
        assert (tmp_path / "shapes.npz").read_bytes() == data
        (tmp_path / "shapes.npz").unlink()


def test_simultaneous_downloads_into_one_folder_wait_for_each_other(tmp_path: Path) -> None:
    async def run() -> list[dict[str, Path]]:
        async with AsyncClient("http://pliant.test", transport=InMemoryService(), retries=QUICK) as client:
            job = await client.submit(POINTS)
            await job.wait(load=False, timeout=30)
            return await asyncio.gather(*[client.download(job.id, tmp_path) for _ in range(4)])

    first, *others = asyncio.run(run())
    assert others == [first] * 3
    assert {path.name for path in tmp_path.iterdir()} == set(first)


def test_a_partial_file_that_another_process_writes_is_left_alone(tmp_path: Path) -> None:
    client, job, data = finished_job(Tearing(10**9))
    name = f".shapes.npz.{hashlib.sha256(data).hexdigest()[:16]}.part"
    held = lock(tmp_path / name)
    assert held is not None
    with held:
        with pytest.raises(WaitTimeout):
            client.download(job, tmp_path, names="shapes.npz", timeout=0.5)
        assert (tmp_path / name).stat().st_size == 0
        (tmp_path / name).rename(tmp_path / "shapes.npz")  # as the other one does at its end
        another = lock(tmp_path / name)
        assert another is not None
        with another:
            assert lock(tmp_path / name) is None
    client.download(job, tmp_path, names="shapes.npz", timeout=30)
    assert (tmp_path / "shapes.npz").read_bytes() == data


def test_folders_and_files_can_be_in_the_home_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with Client("http://pliant.test", transport=InMemoryService(), retries=QUICK) as client:
        result = client.submit(POINTS).wait(folder="~/first", timeout=30)
        result.download("~/second", names="report.json")
        result.save_glb("~/third.glb")
    found = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")}
    assert {"first/shapes.npz", "second/report.json", "third.glb"} <= found


def test_a_file_in_place_of_a_folder_is_refused_before_the_job_is_waited_for(tmp_path: Path) -> None:
    (tmp_path / "tracks.npz").write_bytes(b"mine")
    with Client("http://pliant.test", transport=InMemoryService(steps=math.inf), retries=QUICK) as client:
        job = client.submit(POINTS)
        for folder in (tmp_path / "tracks.npz", tmp_path / "tracks.npz" / "below"):
            with pytest.raises(
                BadArgument, match=r"^folder: expected a folder, got the file .*tracks\.npz\. Choose another folder\.$"
            ):
                job.wait(folder=folder, timeout=30)
        with pytest.raises(BadArgument, match="folder: expected a folder, got the file"):
            client.download(job.id, tmp_path / "tracks.npz")
        job.cancel()
    assert (tmp_path / "tracks.npz").read_bytes() == b"mine"


def test_the_animation_can_be_saved_where_it_was_downloaded(tmp_path: Path) -> None:
    with Client("http://pliant.test", transport=InMemoryService(), retries=QUICK) as client:
        result = client.submit(POINTS).wait(folder=tmp_path, timeout=30)
        assert result.save_glb(tmp_path / "shapes.glb").read_bytes()[:4] == b"glTF"

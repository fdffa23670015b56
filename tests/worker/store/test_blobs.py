"""One suite on a directory, on memory and on an S3 server."""

from __future__ import annotations

import secrets
import shutil
from pathlib import Path

import pytest
from pliant.worker.errors import StoreUnavailable
from pliant.worker.store.blobs import CHUNK, Blobs


@pytest.fixture(params=["directory", "memory", pytest.param("s3", marks=pytest.mark.s3)])
def blobs(request: pytest.FixtureRequest, tmp_path: Path) -> Blobs:
    if request.param == "s3":
        return Blobs.open(f"{request.getfixturevalue('s3_url')}-{secrets.token_hex(3)}")
    return Blobs.open("memory:///" if request.param == "memory" else (tmp_path / "a directory").as_uri())


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "file"
    path.write_bytes(bytes(range(256)) * 10_000)
    return path


def test_what_is_put_is_got(blobs: Blobs, file: Path, tmp_path: Path) -> None:
    content = file.read_bytes()
    assert blobs.put("jobs/a/t/inputs.npz", file) == len(content)
    blob = blobs.get("jobs/a/t/inputs.npz")
    assert blob.size == len(content)
    chunks = list(blob.read())
    assert b"".join(chunks) == content
    assert max(len(chunk) for chunk in chunks) <= CHUNK
    assert b"".join(blob.read(1_000_001, 1_000_011)) == content[1_000_001:1_000_011]
    assert b"".join(blob.read(len(content) - 3)) == content[-3:]
    assert list(blob.read(len(content))) == []
    blobs.fetch("jobs/a/t/inputs.npz", tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == content


@pytest.mark.parametrize(("start", "end"), [(-1, None), (0, 2_560_001), (5, 4), (2_560_001, None)])
def test_a_range_outside_the_file_is_refused(file: Path, start: int, end: int | None) -> None:
    blobs = Blobs.open("memory:///")
    blobs.put("k", file)
    with pytest.raises(ValueError, match="of a file of 2560000 bytes"):
        next(blobs.get("k").read(start, end))


def test_listing_copying_and_deleting(blobs: Blobs, file: Path) -> None:
    for key in ("jobs/a/t/inputs.npz", "jobs/a/u/shapes.npz", "jobs/ab/t/inputs.npz"):
        blobs.put(key, file)
    blobs.copy("jobs/a/t/inputs.npz", "jobs/c/t/inputs.npz")
    assert blobs.sizes("jobs/") == dict.fromkeys(
        ["jobs/a/t/inputs.npz", "jobs/a/u/shapes.npz", "jobs/ab/t/inputs.npz", "jobs/c/t/inputs.npz"], 2_560_000
    )
    blobs.delete("jobs/a/")
    blobs.delete("jobs/a/")
    blobs.delete("jobs/c/t/inputs.npz")
    blobs.delete("jobs/c/t/inputs.npz")
    assert [key for key, _ in blobs.list("jobs/")] == ["jobs/ab/t/inputs.npz"]
    assert all(written.tzinfo is not None for _, written in blobs.list())
    blobs.check()


def test_a_missing_file_is_missing(blobs: Blobs, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        blobs.get("jobs/nobody")
    with pytest.raises(FileNotFoundError):
        blobs.copy("jobs/nobody", "jobs/somebody")
    with pytest.raises(FileNotFoundError):
        blobs.put("jobs/a", tmp_path / "nothing")


def test_a_key_cannot_leave_the_store(tmp_path: Path, file: Path) -> None:
    blobs = Blobs.open((tmp_path / "store").as_uri())
    with pytest.raises(ValueError, match=r"\.\."):
        blobs.put("../outside", file)
    assert not (tmp_path / "outside").exists()


def test_a_store_that_does_not_answer_is_said_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "a-file").write_text("")
    with pytest.raises(StoreUnavailable, match="cannot be used now"):
        Blobs.open((tmp_path / "a-file" / "below").as_uri())
    readonly = Blobs.open((tmp_path / "store").as_uri())
    shutil.rmtree(tmp_path / "store")
    (tmp_path / "store").write_text("in the way")
    with pytest.raises(StoreUnavailable, match="try again"):
        readonly.put("jobs/a", tmp_path / "a-file")

"""Uploads on disk: completion, permissions, limits and expiry, with real locks and files."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import os
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import BinaryIO

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pliant.worker import errors
from pliant.worker.uploads.folder import content, taken
from pliant.worker.uploads.service import MAX_UPLOADS, Capacity, Uploads

CAPACITY = Capacity(max_bytes=1000)


@pytest.fixture
def uploads(tmp_path: Path) -> Uploads:
    return Uploads(directory=tmp_path / "uploads", expiry=3600)


def send(uploads: Uploads, id: str, data: bytes, *, offset: int = 0, finish: bool = True, **more: object) -> None:
    with uploads.write(
        id, offset=offset, length=more.pop("length", None), capacity=more.pop("capacity", CAPACITY)
    ) as writer:  # type: ignore[arg-type]
        writer.write(data)
        if finish:
            writer.finish(sha256=more.pop("sha256", None))  # type: ignore[arg-type]


def now(**later: float) -> datetime:
    return datetime.now(UTC) + timedelta(**later)


@given(data=st.binary(max_size=300), cuts=st.lists(st.integers(0, 300), max_size=5))
@settings(max_examples=30, deadline=None)
def test_an_upload_in_pieces_equals_the_file(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, cuts: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("cut")
    uploads = Uploads(directory=folder / "uploads", expiry=0)
    places = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    for number, (begin, end) in enumerate(itertools.pairwise(places)):
        send(uploads, "cut", data[begin:end], offset=begin, finish=number == len(places) - 2)
        assert uploads.get("cut").offset == end
    there = uploads.get("cut")
    assert (there.complete, there.length) == (True, len(data))
    assert there.sha256 == hashlib.sha256(data).hexdigest() == uploads.take("cut", folder / "taken")
    assert (folder / "taken").read_bytes() == data


def test_incomplete_uploads_cannot_be_used_nor_complete_ones_written(uploads: Uploads, tmp_path: Path) -> None:
    send(uploads, "one", b"half", finish=False)
    assert (uploads.get("one").complete, uploads.get("one").sha256) == (False, None)
    with pytest.raises(errors.Conflict, match="not complete yet") as caught:
        uploads.take("one", tmp_path / "taken")
    assert caught.value.code == "upload_incomplete"
    assert not (tmp_path / "taken").exists()
    send(uploads, "one", b"", offset=4)
    for offset in (0, 4):
        with pytest.raises(errors.Conflict, match="is complete"):
            send(uploads, "one", b"more", offset=offset)
    uploads.take("one", tmp_path / "taken")
    uploads.delete("one")
    assert (tmp_path / "taken").read_bytes() == b"half"
    for gone in (
        lambda: uploads.take("one", tmp_path / "x"),
        lambda: uploads.delete("one"),
        lambda: uploads.get("../x"),
    ):
        with pytest.raises(errors.UnknownUpload):
            gone()
    with pytest.raises(errors.UnknownUpload):
        send(uploads, "one", b"x", offset=4)


def test_a_wrong_offset_is_rejected_and_restarting_is_allowed(uploads: Uploads) -> None:
    send(uploads, "one", b"half", finish=False)
    with pytest.raises(errors.OffsetMismatch, match=r"Continue at 4\.") as caught:
        send(uploads, "one", b"x", offset=3)
    assert caught.value.offset == 4
    send(uploads, "one", b"new")
    assert uploads.get("one").offset == 3


def test_the_declared_length_is_enforced_across_requests(uploads: Uploads) -> None:
    send(uploads, "one", b"half", finish=False, length=6)
    assert uploads.get("one").length == 6
    for data, length in ((b"x", 7), (b"xyz", None), (b"x", None)):
        with pytest.raises(errors.InvalidRequest) as caught:
            send(uploads, "one", data, offset=uploads.get("one").offset, length=length)
        assert caught.value.code == "inconsistent_upload_length"
    assert uploads.get("one").offset == 5, "what fitted is kept"
    send(uploads, "one", b"y", offset=5)
    assert uploads.get("one").complete


def test_a_length_below_the_bytes_held_is_refused_and_not_remembered(uploads: Uploads) -> None:
    send(uploads, "one", b"abc", finish=False)
    with pytest.raises(errors.InvalidRequest, match="expected at least the 3 bytes that are held already, got 2"):
        send(uploads, "one", b"", offset=3, length=2)
    assert uploads.get("one").length is None
    send(uploads, "one", b"d", offset=3)
    assert uploads.get("one").complete


def test_a_piece_beyond_the_length_is_dropped_and_earlier_ones_are_kept(uploads: Uploads) -> None:
    with uploads.write("one", offset=0, length=6, capacity=CAPACITY) as writer:
        writer.write(b"half")
        with pytest.raises(errors.InvalidRequest) as caught:
            writer.write(b"xyz")
    assert caught.value.code == "inconsistent_upload_length"
    assert uploads.get("one").offset == 4
    send(uploads, "one", b"yz", offset=4)
    assert uploads.get("one").sha256 == hashlib.sha256(b"halfyz").hexdigest()


def test_too_large_uploads_are_removed_and_those_over_quota_kept(uploads: Uploads) -> None:
    for length in (None, 1001):
        with pytest.raises(errors.UploadTooLarge, match="at most 1,000 bytes"):
            send(uploads, "one", b"x" * 1001, length=length)
        assert uploads.find("one") is None
    tight = Capacity(max_bytes=1000, quota=100, used=40)
    with uploads.write("one", offset=0, length=None, capacity=tight) as writer:
        writer.write(b"x" * 60)
        with pytest.raises(errors.QuotaExceeded):
            writer.write(b"x")
    assert uploads.get("one").offset == uploads.used() == 60


def test_uploads_with_another_digest_are_removed(uploads: Uploads) -> None:
    with pytest.raises(errors.InvalidRequest) as caught:
        send(uploads, "one", b"half", sha256="0" * 64)
    assert caught.value.code == "digest_mismatch"
    assert uploads.find("one") is None


def test_invalid_ids_and_too_many_uploads_are_refused(uploads: Uploads) -> None:
    for id in ("..", "a/b", "x", "a" * 65, ""):
        with pytest.raises(errors.InvalidRequest):
            send(uploads, id, b"")
    for number in range(MAX_UPLOADS):
        send(uploads, f"number-{number}", b"")
    with pytest.raises(errors.TooManyUploads, match=str(MAX_UPLOADS)):
        send(uploads, "one-more", b"")
    send(uploads.of("somebody else"), "one-more", b"")


def test_owners_do_not_see_each_other(uploads: Uploads, tmp_path: Path) -> None:
    mine, yours = uploads.of("me"), uploads.of("you")
    send(mine, "one", b"mine")
    assert yours.find("one") is None
    send(yours, "one", b"yours, too")
    assert (mine.get("one").offset, yours.get("one").offset) == (4, 10)
    assert uploads.find("one") is None
    mine.delete("one")
    yours.take("one", tmp_path / "taken")


def test_two_processes_cannot_write_to_one_upload(uploads: Uploads) -> None:
    code = (
        "import sys; from pathlib import Path; from pliant.worker.uploads.service import Capacity, Uploads\n"
        "with Uploads(directory=Path(sys.argv[1]), expiry=0).write('one', offset=0, length=None, capacity=Capacity(max_bytes=9)) as w:\n"
        "    w.write(b'abc'); print(flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(uploads.directory)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert other.stdout is not None
    other.stdout.readline()
    for write in (lambda: send(uploads, "one", b"x", offset=3), lambda: uploads.delete("one")):
        with pytest.raises(errors.Conflict, match="being written") as caught:
            write()
        assert caught.value.code == "upload_busy"
    assert uploads.expire(now(days=9)) == [], "what is being written does not expire"
    other.kill()
    other.communicate()
    send(uploads, "one", b"def", offset=3)
    assert uploads.get("one").sha256 == hashlib.sha256(b"abcdef").hexdigest()


def test_only_unused_uploads_expire(uploads: Uploads, tmp_path: Path) -> None:
    send(uploads, "part", b"x", finish=False)
    send(uploads.of("you"), "whole", b"x")
    expires = uploads.get("part").expires_at
    assert expires is not None
    assert abs((expires - now(hours=1)).total_seconds()) < 60
    assert uploads.expire(now(minutes=59)) == []
    assert sorted(uploads.expire(now(minutes=61))) == ["part", "whole"]
    assert [path for path in uploads.directory.rglob("*") if path.is_file()] == []
    send(uploads, "used", b"x")
    (file,) = uploads.directory.glob("*/used/whole-*")
    os.utime(file, (0, 0))
    uploads.take("used", tmp_path / "taken")
    assert uploads.expire(now(minutes=59)) == [], "using it begins its time anew"
    for_ever = Uploads(directory=uploads.directory, expiry=0)
    assert for_ever.get("used").expires_at is None
    assert for_ever.expire(now(days=9999)) == []


def test_fsck_finds_inconsistent_uploads(uploads: Uploads) -> None:
    send(uploads, "part", b"x", finish=False, length=3)
    send(uploads, "whole", b"x")
    assert list(uploads.findings(now())) == []
    assert sorted(uploads.findings(now(hours=2))) == [
        "Upload part should have expired.",
        "Upload whole should have expired.",
    ]
    (part,) = uploads.directory.glob("*/part/part")
    (part.parent / "stray").touch()
    assert list(uploads.findings(now())) == ["Upload part holds length, part, stray; expected exactly one file."]
    for path in part.parent.iterdir():
        path.unlink()
    assert list(uploads.findings(now())) == ["Upload part holds nothing; expected exactly one file."]


def test_a_request_that_fills_the_disk_is_rolled_back(small_disk: Path) -> None:
    uploads, room = Uploads(directory=small_disk / "uploads", expiry=0), Capacity(max_bytes=2**30)
    with pytest.raises(OSError, match="No space"):
        send(uploads, "announced", b"", length=4_000_000, capacity=room)
    send(uploads, "one", b"x" * 1_000_000, finish=False, capacity=room)
    with uploads.write("one", offset=1_000_000, length=None, capacity=room) as writer:
        writer.write(b"y" * 1_000_000)
        with pytest.raises(OSError, match="No space"):
            writer.write(b"y" * 2_000_000)
    assert uploads.get("one").offset == 1_000_000
    send(uploads, "one", b"z" * 1_000_000, offset=1_000_000, capacity=room)
    assert uploads.get("one").sha256 == hashlib.sha256(b"x" * 1_000_000 + b"z" * 1_000_000).hexdigest()


def test_uploads_are_copied_if_the_file_system_has_no_links(
    uploads: Uploads, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    send(uploads, "one", b"abc")

    def refused(*_: object) -> None:
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", refused)
    uploads.take("one", tmp_path / "taken")
    assert (tmp_path / "taken").read_bytes() == b"abc"


def test_concurrent_uploads_respect_the_quota(uploads: Uploads) -> None:
    """Eight chunked uploads of unknown length once put 400 MB on the disk under a quota of 120."""
    tight = Capacity(max_bytes=10**9, quota=120 << 20, used=20 << 20)
    piece, written, refused = b"x" * (1 << 20), 0, 0
    with contextlib.ExitStack() as stack:
        writers = [
            stack.enter_context(uploads.write(f"up-{number}", offset=0, length=None, capacity=tight))
            for number in range(8)
        ]
        for _ in range(20):
            for writer in list(writers):
                try:
                    writer.write(piece)
                    written += 1
                except errors.QuotaExceeded:
                    writers.remove(writer)
                    refused += 1
        assert written <= 100
        assert refused > 0
        assert written << 20 <= uploads.used() <= 100 << 20
    assert uploads.used() == written << 20, "what was reserved and not used is given back"
    assert list(uploads.directory.glob("*/*/reserved")) == []


def test_a_declared_length_is_reserved_at_once_and_a_refusal_leaves_nothing(uploads: Uploads) -> None:
    tight = Capacity(max_bytes=1000, quota=100, used=0)
    with uploads.write("one", offset=0, length=80, capacity=tight) as writer:
        assert uploads.used() == 80
        with pytest.raises(errors.QuotaExceeded, match="80 of 100 bytes"):
            send(uploads, "two", b"", length=30, capacity=tight)
        assert [folder.name for folder in uploads.directory.glob("*/*")] == ["one"]
        writer.write(b"x" * 30)
    assert uploads.used() == 30
    send(uploads, "two", b"y" * 30, length=30, capacity=tight)


def test_a_reservation_ends_with_its_process(uploads: Uploads) -> None:
    send(uploads, "one", b"half", finish=False)
    (next(uploads.directory.glob("*/one")) / "reserved").write_text("1000000")
    assert uploads.used() == 4
    assert list(uploads.findings(now())) == []


def test_appending_does_not_reread_the_upload(uploads: Uploads, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rereading 400 MB for a small PATCH takes a third of a second of processor time."""
    read: list[int] = []
    whole = hashlib.file_digest

    def counted(file: BinaryIO, name: str) -> object:
        read.append(os.fstat(file.fileno()).st_size)
        return whole(file, name)  # type: ignore[arg-type]

    monkeypatch.setattr(hashlib, "file_digest", counted)
    for offset in range(9):
        send(uploads, "slow", b"x", offset=offset, finish=False)
    assert read == []
    send(uploads, "slow", b"y", offset=9)
    assert read == [10]
    assert uploads.get("slow").sha256 == hashlib.sha256(b"x" * 9 + b"y").hexdigest()


def test_an_upload_is_found_while_it_is_being_completed(uploads: Uploads, monkeypatch: pytest.MonkeyPatch) -> None:
    send(uploads, "whole", b"1234", finish=False)

    def completed_meanwhile(folder: Path) -> Path | None:
        file = content(folder)
        if file is not None and file.name == "part":
            file.rename(file.with_name(f"whole-{'0' * 64}"))
        return file

    monkeypatch.setattr("pliant.worker.uploads.service.content", completed_meanwhile)
    held = uploads.get("whole")
    assert (held.complete, held.offset) == (True, 4)


def test_an_upload_that_is_removed_meanwhile_neither_counts_nor_fails_the_count(
    uploads: Uploads, monkeypatch: pytest.MonkeyPatch
) -> None:
    send(uploads, "kept", b"1234")
    gone = uploads.directory / "owner" / "gone"
    listed = [*uploads.directory.glob("*/*"), gone]
    with monkeypatch.context() as meanwhile:  # each was there when the folder was listed and when it was looked at
        meanwhile.setattr(Path, "is_dir", lambda _: True)
        assert taken(gone) == 0
    monkeypatch.setattr(Path, "glob", lambda *_: iter(listed))
    assert uploads.used() == 4
    assert list(uploads.findings(now())) == []

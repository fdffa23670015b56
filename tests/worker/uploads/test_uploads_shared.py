"""Uploads that several API processes share: begun at one, continued at another."""

from __future__ import annotations

import hashlib
import secrets
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
from pliant.worker import errors
from pliant.worker.jobs.service import Jobs
from pliant.worker.maintenance.fsck import findings
from pliant.worker.maintenance.reconciler import Reconciler
from pliant.worker.settings import Settings
from pliant.worker.store.blobs import Blobs
from pliant.worker.store.connection import connect
from pliant.worker.uploads import shared, states
from pliant.worker.uploads.service import MAX_UPLOADS, Capacity, Uploads
from pliant.worker.uploads.shared import SharedUploads, open_uploads
from pliant.worker.uploads.states import RESERVED_FOR, UploadStates

CAPACITY = Capacity(max_bytes=1000)
DATA = bytes(range(256)) * 3
DIGEST = hashlib.sha256(DATA).hexdigest()


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "PIECE", 100)


@pytest.fixture
def hosts(settings: Settings, tmp_path: Path) -> list[SharedUploads]:
    """Uploads as opened by two API processes: each has its own connections, and they share no disk."""
    blobs = Blobs.open("memory:///")
    return [
        SharedUploads(
            directory=tmp_path / name, expiry=3600, blobs=blobs,
            states=UploadStates(connect(settings.redis, decode=True), queue=settings.queue),
        )
        for name in ("one", "two")
    ]  # fmt: skip


def send(
    uploads: Uploads, id: str, data: bytes, *, offset: int = 0, finish: bool = True, length: int | None = None,
    sha256: str | None = None, capacity: Capacity = CAPACITY,
) -> None:  # fmt: skip
    with uploads.write(id, offset=offset, length=length, capacity=capacity) as writer:
        for start in range(0, len(data), 70):
            writer.write(data[start : start + 70])
        if finish:
            writer.finish(sha256=sha256)


def test_an_upload_begun_at_one_process_continues_at_another(hosts: list[SharedUploads], tmp_path: Path) -> None:
    one, two = hosts
    send(one, "film", DATA[:333], finish=False, length=len(DATA))
    there = two.get("film")
    assert (there.offset, there.length, there.complete) == (333, len(DATA), False)
    with pytest.raises(errors.Conflict, match="not complete"):
        two.take("film", tmp_path / "early")
    send(two, "film", DATA[333:400], offset=333, finish=False)
    send(one, "film", DATA[400:], offset=400, sha256=DIGEST)
    assert two.get("film").sha256 == DIGEST == two.take("film", tmp_path / "taken")
    assert (tmp_path / "taken").read_bytes() == DATA
    with pytest.raises(errors.Conflict, match="is complete"):
        send(two, "film", b"x")
    assert one.used() == two.used() == len(DATA)
    assert list(one.findings(datetime.now(UTC))) == []
    two.delete("film")
    with pytest.raises(errors.UnknownUpload):
        one.take("film", tmp_path / "late")
    assert one.blobs.list() == []
    assert not list(tmp_path.glob("one/*")), "nothing is on the disk of one host"


def test_bytes_received_before_a_broken_connection_are_kept(hosts: list[SharedUploads]) -> None:
    one, two = hosts

    def broken() -> None:
        with one.write("cut", offset=0, length=None, capacity=CAPACITY) as writer:
            writer.write(DATA[:130])
            raise ConnectionError

    with pytest.raises(ConnectionError):
        broken()
    assert two.get("cut").offset == 130


def test_the_newest_request_wins(hosts: list[SharedUploads]) -> None:
    one, two = hosts

    def overtaken() -> None:
        with one.write("race", offset=0, length=len(DATA), capacity=CAPACITY) as old:
            old.write(DATA[:150])
            held = two.get("race").offset
            send(two, "race", DATA[held:], offset=held, sha256=DIGEST)
            old.write(DATA[150:300])

    def deleted() -> None:
        with one.write("gone", offset=0, length=None, capacity=CAPACITY) as old:
            two.delete("gone")
            old.write(DATA[:150])

    with pytest.raises(errors.Conflict, match="newer request"):
        overtaken()
    assert two.get("race").sha256 == DIGEST
    assert len(two.blobs.list()) == len(two.states.get(two.name("race")).pieces), "its pieces are removed"
    with pytest.raises(errors.Conflict):
        deleted()
    assert two.find("gone") is None


def test_simultaneous_starts_do_not_mix_uploads(hosts: list[SharedUploads], monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = hosts
    send(one, "again", DATA[:200], finish=False)
    before = one.states.get(one.name("again"))
    send(two, "again", DATA, sha256=DIGEST)
    assert one.blobs.list(f"uploads/{one.name('again')}/{before.generation}/") == [], "begun again"
    monkeypatch.setattr(SharedUploads, "_state", lambda *_: before)
    with pytest.raises(errors.Conflict, match="newer request"):
        send(one, "again", DATA)
    monkeypatch.undo()
    assert two.get("again").sha256 == DIGEST


def test_unknown_uploads_are_errors(hosts: list[SharedUploads], tmp_path: Path) -> None:
    for act in (
        lambda: hosts[0].take("none", tmp_path / "x"),
        lambda: hosts[0].get("../x"),
        lambda: hosts[0].get("none"),
    ):
        with pytest.raises(errors.UnknownUpload):
            act()


def test_a_long_held_space_lock_makes_the_store_unavailable(
    hosts: list[SharedUploads], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = hosts
    with one.states.counting():
        monkeypatch.setattr(states, "COUNTING_WITHIN", 0.01)
        with pytest.raises(errors.StoreUnavailable, match="being counted"), two.states.counting():
            pass


def test_wrong_offsets_lengths_and_digests_are_refused(hosts: list[SharedUploads]) -> None:
    one, two = hosts
    with pytest.raises(errors.UnknownUpload):
        send(one, "new", DATA, offset=5)
    send(one, "new", DATA[:200], finish=False, length=len(DATA))
    with pytest.raises(errors.OffsetMismatch) as wrong:
        send(two, "new", DATA[100:], offset=100)
    assert wrong.value.offset == 200
    send(one, "open", b"abc", finish=False)
    with pytest.raises(errors.InvalidRequest, match="expected at least the 3 bytes that are held already, got 2"):
        send(two, "open", b"", offset=3, length=2)
    assert two.get("open").length is None
    two.delete("open")
    with pytest.raises(errors.InvalidRequest, match="768"):
        send(two, "new", DATA[200:], offset=200, length=999)
    with pytest.raises(errors.InvalidRequest, match="768"):
        send(two, "new", DATA, offset=200)
    with pytest.raises(errors.InvalidRequest, match="768"):
        send(two, "new", b"", offset=two.get("new").offset)
    held = two.get("new").offset
    with pytest.raises(errors.InvalidRequest, match="changed in transit"):
        send(two, "new", DATA[held:], offset=held, sha256="0" * 64)
    assert one.find("new") is None
    assert one.blobs.list() == []
    for bad in ("a", "../x"):
        with pytest.raises((errors.UnknownUpload, errors.InvalidRequest)):
            send(one, bad, b"x")


def test_limits_apply_across_all_processes(hosts: list[SharedUploads]) -> None:
    one, two = hosts
    with pytest.raises(errors.UploadTooLarge):
        send(one, "large", bytes(1001))
    assert (one.find("large"), one.blobs.list()) == (None, [])
    tight = Capacity(max_bytes=10_000, quota=1000, used=100)
    with one.write("first", offset=0, length=600, capacity=tight) as writer:
        with pytest.raises(errors.QuotaExceeded):
            send(two, "second", DATA[:400], length=400, capacity=tight)
        assert two.find("second") is None, "what is refused before its first byte leaves nothing"
        send(two, "third", DATA[:300], capacity=tight)
        assert two.used() == 900
        writer.write(DATA[:50])
    assert two.used() == 350, "the reservation is released"
    state = one.states.get(one.name("first")).model_copy(update={"reserved": 900})
    assert (state.taken(state.touched), state.taken(state.touched + RESERVED_FOR)) == (900, 50), "of a killed process"
    for number in range(MAX_UPLOADS - 2):
        send(one, f"many-{number}", b"x")
    with pytest.raises(errors.TooManyUploads):
        send(two, "one-more", b"x")
    send(two.of("ada"), "one-more", b"x")
    assert one.find("one-more") is None


def test_a_slow_upload_keeps_its_reservation(hosts: list[SharedUploads], monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = hosts
    clock, tight = [1e9], Capacity(max_bytes=10_000, quota=1000)
    monkeypatch.setattr(shared, "time", SimpleNamespace(time=lambda: clock[0]))
    with one.write("slow", offset=0, length=900, capacity=tight) as writer:
        for _ in range(4):  # bytes that do not fill a piece, for longer than a reservation lasts
            clock[0] += RESERVED_FOR / 2 + 1
            writer.write(b"x")
            assert two.used() == 900
        clock[0] += RESERVED_FOR + 1
        assert two.used() == 0, "no byte came, so the process may have been killed"


def test_unused_uploads_expire_and_stray_pieces_are_removed(hosts: list[SharedUploads], tmp_path: Path) -> None:
    one, two = hosts
    send(one, "old", DATA)
    send(one, "used", DATA)
    one.blobs.write("uploads/nobody/none/abc/00000-x", b"stray")
    later = datetime.now(UTC) + timedelta(hours=1, minutes=30)
    assert sorted(one.findings(later)) == [
        "File uploads/nobody/none/abc/00000-x belongs to no upload.",
        "Upload old should have expired.",
        "Upload used should have expired.",
    ]
    state = one.states.get(one.name("used"))
    one.states.swap(one.name("used"), state, state.model_copy(update={"touched": later.timestamp()}))
    assert two.expire(later) == ["old"]
    assert len(one.blobs.list()) == len(state.pieces)
    assert replace(one, expiry=0).expire(later + timedelta(days=999)) == []
    one.blobs.delete("uploads/")
    assert next(one.findings(later)).startswith("Upload used has lost")
    with pytest.raises(errors.UnknownUpload):
        one.take("used", tmp_path / "x")


@pytest.mark.s3
def test_uploads_are_shared_if_files_are_stored_in_s3(settings: Settings, s3_url: str, tmp_path: Path) -> None:
    on_s3 = replace(settings, blob_url=f"{s3_url}-{secrets.token_hex(3)}")
    jobs = Jobs.open(on_s3)
    uploads = open_uploads(on_s3, jobs.blobs)
    assert isinstance(uploads, SharedUploads)
    assert not isinstance(open_uploads(settings, Blobs.open(settings.blobs)), SharedUploads)
    send(uploads, "film", DATA[:400], finish=False)
    send(open_uploads(on_s3, Blobs.open(on_s3.blobs)), "film", DATA[400:], offset=400)
    assert uploads.take("film", tmp_path / "taken") == DIGEST
    Reconciler(jobs=jobs).tick()
    assert uploads.get("film").complete
    assert findings(jobs, pause=0) == []

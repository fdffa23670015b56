"""The blob store: one suite on a directory, in memory and on an S3 server; and a store that hangs."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from obstore.store import MemoryStore
from pliant.worker.errors import InvalidSetting, StoreUnavailable
from pliant.worker.store.blobs import CHUNK, CLIENT, SWITCHES, TEXTS, Blobs, client_options
from pliant.worker.store.calls import AT_ONCE, WAITING, RemoteCalls
from serving import until


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


def test_temporary_files_of_killed_processes_are_removed_once_old(tmp_path: Path) -> None:
    """Between file systems a file is copied, which takes seconds; what a killed process had copied stayed for ever."""
    blobs = Blobs.open((tmp_path / "store").as_uri())
    blobs.write("jobs/one/whole", b"x")
    old, new = (tmp_path / "store" / "jobs" / "one" / name for name in ("half#1", "half#2"))
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    assert [key for key, _ in blobs.list()] == ["jobs/one/whole"]
    blobs.clear_unfinished(before=datetime.now(UTC) - timedelta(hours=1))
    assert (old.exists(), new.exists()) == (False, True)
    Blobs.open("memory:///").clear_unfinished(before=datetime.now(UTC))


def test_a_stored_file_is_read_back(blobs: Blobs, file: Path, tmp_path: Path) -> None:
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


def test_files_of_a_local_store_are_on_the_disk_before_they_are_named(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A record survives a power failure; the file that it names must, too."""
    blobs, synced = Blobs.open((tmp_path / "store").as_uri()), set[int]()
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.add(os.fstat(descriptor).st_ino))
    blobs.put("jobs/a/inputs.npz", file)
    blobs.write("jobs/b/part", b"bytes")
    blobs.copy("jobs/a/inputs.npz", "jobs/c/inputs.npz")
    store = tmp_path / "store"
    names = [
        store,
        store / "jobs",
        *(store / "jobs" / each for each in ("a/inputs.npz", "a", "b/part", "b", "c", "c/inputs.npz")),
    ]
    assert synced == {path.stat().st_ino for path in names}


@pytest.mark.parametrize(("start", "end"), [(-1, None), (0, 2_560_001), (5, 4), (2_560_001, None)])
def test_a_range_outside_the_file_is_refused(file: Path, start: int, end: int | None) -> None:
    blobs = Blobs.open("memory:///")
    blobs.put("k", file)
    with pytest.raises(ValueError, match="of a file of 2560000 bytes"):
        next(blobs.get("k").read(start, end))


def test_files_are_listed_copied_and_deleted(blobs: Blobs, file: Path) -> None:
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


def test_missing_files_raise_file_not_found(blobs: Blobs, tmp_path: Path) -> None:
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


def test_an_unavailable_store_is_an_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "a-file").write_text("")
    with pytest.raises(StoreUnavailable, match="is unavailable"):
        Blobs.open((tmp_path / "a-file" / "below").as_uri())
    readonly = Blobs.open((tmp_path / "store").as_uri())
    shutil.rmtree(tmp_path / "store")
    (tmp_path / "store").write_text("in the way")
    with pytest.raises(StoreUnavailable, match="try again"):
        readonly.put("jobs/a", tmp_path / "a-file")


@pytest.mark.skipif(not Path("/proc/self/io").exists(), reason="reads /proc")
def test_a_local_store_links_instead_of_copying(tmp_path: Path) -> None:
    """Spool, store and scratch directory share one file of inputs instead of holding three copies."""
    canonical = tmp_path / "canonical.npz"
    canonical.write_bytes(bytes(8_000_000))
    blobs = Blobs.open((tmp_path / "store").as_uri())
    before = written()
    blobs.put("jobs/a/t/inputs.npz", canonical)
    blobs.put("jobs/a/t/inputs.npz", canonical)  # repeated after a lost answer
    blobs.fetch("jobs/a/t/inputs.npz", tmp_path / "inputs.npz")
    assert written() - before < 100_000
    assert canonical.stat().st_nlink == 3
    canonical.unlink()
    assert list(blobs.sizes()) == ["jobs/a/t/inputs.npz"]
    assert (tmp_path / "inputs.npz").stat().st_size == 8_000_000


def test_files_that_cannot_be_linked_are_copied(tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def other_disk(*_: object) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", other_disk)
    blobs = Blobs.open((tmp_path / "store").as_uri())
    blobs.put("jobs/a", file)
    blobs.fetch("jobs/a", tmp_path / "copy")
    assert file.stat().st_nlink == (tmp_path / "copy").stat().st_nlink == 1
    assert (tmp_path / "copy").read_bytes() == file.read_bytes()
    with pytest.raises(FileNotFoundError):
        blobs.fetch("jobs/nothing", tmp_path / "nothing")


def refusal(calls: RemoteCalls, call: Callable[[], object]) -> str:
    with pytest.raises(StoreUnavailable) as caught:
        calls.run(call, seconds=0.01)
    return str(caught.value)


def test_hanging_calls_end_at_their_time_limit_and_further_ones_fail_at_once() -> None:
    calls, go_on = RemoteCalls(), threading.Event()
    assert calls.run(lambda: 7, seconds=5) == 7
    with pytest.raises(StoreUnavailable, match=r"no answer within 0\.1 s"):
        calls.run(go_on.wait, seconds=0.1)
    with ThreadPoolExecutor(AT_ONCE + WAITING) as threads:
        hanging = [threads.submit(calls.run, go_on.wait, seconds=600) for _ in range(AT_ONCE + WAITING)]
        try:
            until(lambda: "too many requests" in refusal(calls, go_on.wait))
        finally:
            go_on.set()
        assert all(each.result() for each in hanging)
    assert calls.run(lambda: 8, seconds=5) == 8, "it recovers"


@pytest.mark.slow
def test_a_store_that_never_replies_is_unavailable(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{silent.getsockname()[1]}", "AWS_ALLOW_HTTP": "true",
            "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_REGION": "us-east-1",
        }.items():  # fmt: skip
            monkeypatch.setenv(name, value)
        blobs = Blobs.open("s3://bucket/prefix")
        began = time.monotonic()
        with ThreadPoolExecutor(3) as threads:
            calls = [
                threads.submit(call) for call in (blobs.check, lambda: blobs.get("k"), lambda: blobs.list("jobs/"))
            ]
            problems = [each.exception() for each in calls]
        assert time.monotonic() - began < 10
        for problem in problems:
            assert isinstance(problem, StoreUnavailable)
            assert "127.0.0.1" not in str(problem)


REFUSAL = b"""<?xml version="1.0" encoding="UTF-8"?>
<Error><Code>AuthorizationHeaderMalformed</Code><Message>the region 'us-east-1' is wrong; expecting 'eu-central-1'</Message></Error>"""


class RefusesEverything(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(400)
        self.send_header("content-length", str(len(REFUSAL)))
        self.end_headers()
        self.wfile.write(REFUSAL)

    def log_message(self, format: str, *args: object) -> None:
        pass


def test_the_log_has_the_reason_of_an_s3_server_and_of_a_failed_connection(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name, value in {
        "REGION": "us-east-1",
        "ACCESS_KEY_ID": "k",
        "SECRET_ACCESS_KEY": "s",
        "ALLOW_HTTP": "1",
    }.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    with ThreadingHTTPServer(("127.0.0.1", 0), RefusesEverything) as server:
        threading.Thread(target=server.serve_forever).start()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
        with pytest.raises(StoreUnavailable):
            Blobs.open("s3://bucket/prefix").check()
        server.shutdown()
    with pytest.raises(StoreUnavailable):
        Blobs.open("s3://bucket/prefix").check()
    told = (record.getMessage() for record in caplog.records)
    refused, unreachable = (line for line in told if f":{server.server_port}/" in line)  # not of calls of earlier tests
    assert "expecting 'eu-central-1'" in refused
    assert "Connection refused" in unreachable
    assert "\n" not in refused + unreachable


def test_every_store_variable_is_documented() -> None:
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "s3.md").read_text()
    credentials = ("access_key_id", "secret_access_key", "session_token", "region", "endpoint_url", "ca_bundle")
    for name in (*SWITCHES, *TEXTS, *credentials):
        assert f"`AWS_{name.upper()}`" in page, name


def written() -> int:
    """Return the bytes that this process has written."""
    counters = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(counters["wchar"])


def test_connection_variables_are_passed_to_the_store(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """obstore ignores `AWS_` variables about the connection once it is given options, so each is passed on."""
    bundle = tmp_path / "ca.pem"
    bundle.write_text("a certificate")
    variables = {
        "AWS_ALLOW_HTTP": "TRUE", "AWS_ALLOW_INVALID_CERTIFICATES": "0", "AWS_PROXY_URL": "http://proxy:3128",
        "AWS_PROXY_EXCLUDES": "", "AWS_CA_BUNDLE": str(bundle), "AWS_REGION": "us-east-1",
    }  # fmt: skip
    assert client_options(variables) == {
        "allow_http": True, "allow_invalid_certificates": False, "proxy_url": "http://proxy:3128",
        "root_certificate": "a certificate",
    }  # fmt: skip
    assert client_options({}) == {}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    given: dict[str, object] = {}

    def opened(url: str, **options: object) -> MemoryStore:
        given.update(options["client_options"])  # type: ignore[call-overload]
        return MemoryStore()

    monkeypatch.setattr("pliant.worker.store.blobs.from_url", opened)
    Blobs.open("s3://bucket/prefix")
    assert given == {**CLIENT, **client_options(variables)}


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (
            "AWS_CA_BUNDLE",
            "/no/such/file",
            "AWS_CA_BUNDLE: expected a PEM file that this user can read, got .*No such file",
        ),
        ("AWS_CA_BUNDLE", __file__, "AWS_… variables: .*No certificates found"),
        (
            "AWS_SKIP_SIGNATURE",
            "maybe",
            "AWS_… variables: expected values with which s3://bucket/prefix can be opened, .*boolean",
        ),
    ],
)
def test_an_invalid_store_variable_is_named_in_place_of_the_url(
    name: str, value: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(InvalidSetting, match=words):
        Blobs.open("s3://bucket/prefix")


@pytest.mark.parametrize(
    "url", ["/srv/blobs", "ftp://host/blobs", "s3:///blobs", "s3://[bucket/blobs", "file://host/blobs", "file:blobs"]
)
def test_blob_stores_of_other_kinds_are_refused(url: str) -> None:
    expected = "PLIANT_BLOB_URL: expected file:///FOLDER or s3://BUCKET/PREFIX, got "
    with pytest.raises(InvalidSetting, match=re.escape(f"{expected}{url!r}")):
        Blobs.open(url)

"""The same faults against three clients: ours, PyODM and replicate-python, each asked through `clients_child.py`.

    python -m venv build/other && build/other/bin/pip install pyodm replicate
    python benchmarks/clients.py --other build/other/bin/python

One small server here speaks as much of the three services' languages as the wishes need, and misbehaves on demand. Each client
runs in a process of its own with its own defaults. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from pliant.schemas.job import Artifact, Interpretation, Job, Problem, Status
from pliant.schemas.options import Options

CLIENTS = ("pyodm", "replicate", "pliant")
SIZE = 24_000_000
"""Bytes of the file that is fetched, and of the one that is sent."""
REASON = "The worker ran out of memory. Take fewer points."
FIRST_LOOKS = 2
"""Requests that a client makes before its wish."""
CHILD = Path(__file__).with_name("clients_child.py")


@dataclass
class House:
    """The server's state: what it holds, what it was asked, and which fault is due."""

    content: bytes
    final: bool = True
    failed: bool = False
    busy: int = 0
    """How many looks at the job are answered 503 with a date in Retry-After."""
    cut: int = 0
    """How many downloads break off in their middle."""
    wrong: bool = False
    lose: bool = False
    """The answer to the next job that is made is lost."""
    made: int = 0
    served: int = 0
    looks: list[float] = field(default_factory=list)
    tokens: list[str] = field(default_factory=list)
    connections: list[socket.socket] = field(default_factory=list)


class Handler(BaseHTTPRequestHandler):
    """Speaks NodeODM's, Replicate's and our language, as far as it is needed."""

    protocol_version = "HTTP/1.1"
    house: House

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        path = urlsplit(self.path)
        if path.path.endswith(("/file", "/all.zip")):
            self._file()
        elif path.path == "/info":
            self._note(parse_qs(path.query))
            self._json(200, {"version": "2.2.0"})
        else:
            self._look(path.path, parse_qs(path.query))

    def do_POST(self) -> None:
        house = self.house
        length, chunked = (
            int(self.headers.get("content-length", 0)),
            "chunked" in self.headers.get("transfer-encoding", ""),
        )
        while chunked and (size := int(self.rfile.readline(), 16)) >= 0:
            self.rfile.read(size + 2)
            if size == 0:
                break
        while length > 0:
            length -= len(self.rfile.read(min(length, 1 << 16)))
        key = self.headers.get("idempotency-key", "")
        if self.path in ("/task/new/init", "/task/new/commit/job", "/v1/predictions", "/v1/jobs"):
            begins = self.path != "/task/new/init"
            house.made += begins and not (key and key == getattr(house, "key", None))
            house.key = key  # type: ignore[attr-defined]
            if begins and house.lose:
                house.lose = False
                self.close_connection = True
                return
        said = {"uuid": "job", "success": True}
        if self.path == "/v1/jobs":
            self._json(202, json.loads(job(house).model_dump_json()))
        elif self.path.startswith("/v1/"):
            self._json(201, prediction(house) if "predictions" in self.path else a_file())
        else:
            self._json(200, said)

    def setup(self) -> None:
        super().setup()
        self.house.connections.append(self.connection)

    def _note(self, query: dict[str, list[str]]) -> None:
        self.house.looks.append(time.perf_counter())
        self.house.tokens.append(self.headers.get("authorization", "") + "".join(query.get("token", [])))

    def _look(self, path: str, query: dict[str, list[str]]) -> None:
        house = self.house
        self._note(query)
        if len(house.looks) > FIRST_LOOKS and house.busy > 0:
            house.busy -= 1
            later = {"Retry-After": format_datetime(datetime.now(UTC) + timedelta(seconds=3), usegmt=True)}
            problem = Problem(title="Busy", status=503, code="busy", detail="Busy. Try later.", retryable=True)
            self._json(503, problem.model_dump(), later, "application/problem+json")
        elif path.startswith("/task/"):
            code = 40 if house.final else 20
            status = {"code": 30, "errorMessage": REASON} if house.failed else {"code": code}
            known = {"uuid": "job", "name": "", "dateCreated": 0, "processingTime": 0, "options": [], "imagesCount": 1}
            self._json(200, {**known, "status": status})
        elif "predictions" in path:
            self._json(200, prediction(house))
        else:
            self._json(200, json.loads(job(house).model_dump_json()))

    def _file(self) -> None:
        house, first, last = self.house, 0, SIZE - 1
        asked = self.headers.get("range", "").removeprefix("bytes=")
        if asked:
            first, last = (int(part) if part else SIZE - 1 for part in asked.split("-"))
        part = house.content[first : last + 1]
        if house.wrong and first <= SIZE // 2 <= last:
            at = SIZE // 2 - first
            part = part[:at] + bytes([part[at] ^ 1]) + part[at + 1 :]
        self.send_response(206 if asked else 200)
        tag = f'"{hashlib.sha256(house.content).hexdigest()}"'
        for name, value in (("ETag", tag), ("Accept-Ranges", "bytes"), ("Content-Length", str(len(part)))):
            self.send_header(name, value)
        if asked:
            self.send_header("Content-Range", f"bytes {first}-{last}/{SIZE}")
        self.end_headers()
        broken = house.cut > 0 and len(part) > 1_000_000
        sent = part[: len(part) // 2] if broken else part
        try:
            self.wfile.write(sent)
        except ConnectionError:
            return
        house.served += len(sent)
        if broken:
            house.cut -= 1
            self.close_connection = True

    def _json(
        self, status: int, said: Any, headers: dict[str, str] | None = None, kind: str = "application/json"
    ) -> None:
        body = json.dumps(said).encode()
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)


def job(house: House) -> Job:
    """Return our record of the one job."""
    now = datetime.now(UTC)
    seen = Interpretation(
        num_frames=9, num_points=9, num_faces=0, hidden_fraction=0, mesh_source="none", has_ground_truth=False,
        has_rotations=False, layout="tracks (F, P, 2)",
    )  # fmt: skip
    status = Status.FAILED if house.failed else Status.SUCCEEDED if house.final else Status.RUNNING
    error = Problem(title="Failed", status=500, code="out_of_memory", detail=REASON) if house.failed else None
    sha = hashlib.sha256(house.content).hexdigest()
    held = [Artifact(name="file", media_type="application/octet-stream", bytes=SIZE, sha256=sha)]
    return Job(
        id="job", status=status, created_at=now, options=Options(), interpretation=seen, artifacts=held, error=error
    )


def prediction(house: House) -> dict[str, Any]:
    """Return Replicate's record of it."""
    status = "failed" if house.failed else "succeeded" if house.final else "processing"
    return {
        "id": "job", "model": "a/b", "version": "v", "status": status, "input": {}, "output": None, "logs": "",
        "error": REASON if house.failed else None, "metrics": {}, "created_at": "", "urls": {"get": "", "cancel": ""},
    }  # fmt: skip


def a_file() -> dict[str, Any]:
    """Return Replicate's record of an uploaded file."""
    return {
        "id": "file", "name": "f", "content_type": "x/y", "size": SIZE, "etag": "", "checksums": {}, "metadata": {},
        "created_at": "", "expires_at": None, "urls": {"get": ""},
    }  # fmt: skip


class Door:
    """The listening socket, which can be shut for a while."""

    def __init__(self, house: House) -> None:
        self.handler = type("Bound", (Handler,), {"house": house})
        self.port = 0
        self.open()

    def open(self) -> None:
        self.server = ThreadingHTTPServer(("127.0.0.1", self.port), self.handler)
        self.server.daemon_threads = True
        self.server.handle_error = lambda *_: None  # type: ignore[method-assign]  # a client that hangs up is a part of it
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def shut(self) -> None:
        self.server.shutdown()
        self.server.server_close()
        for connection in self.handler.house.connections:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


@contextmanager
def serving(content: bytes) -> Iterator[tuple[House, Door]]:
    """Give a fresh house and its door."""
    house = House(content)
    door = Door(house)
    yield house, door
    door.shut()


def ask(other: str, client: str, wish: str, door: Door, file: Path) -> dict[str, Any]:
    """Have a client do one thing."""
    python = sys.executable if client == "pliant" else other
    command = [python, str(CHILD), client, wish, f"http://127.0.0.1:{door.port}", str(file)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    assert ran.returncode == 0, ran.stderr
    outcome: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    return outcome


def ending(found: dict[str, Any]) -> str:
    """Say how it ended."""
    if "got" in found:
        return f"ends well after {found['seconds']:.1f} s"
    return f"`{found['raised']}` after {found['seconds']:.1f} s: {found['said'][:90]}"


def away(house: House, door: Door, run: Callable[[str], dict[str, Any]]) -> str:
    """The service is away for 6 s in mid wait, kill and all."""
    house.final = False

    def restart() -> None:
        while len(house.looks) <= FIRST_LOOKS:
            time.sleep(0.02)
        door.shut()
        time.sleep(6)
        house.final = True
        door.open()

    threading.Thread(target=restart, daemon=True).start()
    return ending(run("wait"))


def busy(house: House, door: Door, run: Callable[[str], dict[str, Any]]) -> str:
    """The job's status is answered 503, with a date 2 to 3 s ahead in Retry-After."""
    del door
    house.busy = 1
    found = run("wait")
    gaps = [after - before for before, after in zip(house.looks, house.looks[1:], strict=False)]
    return f"{ending(found)}; asked again after {gaps[-1]:.1f} s" if "got" in found else ending(found)


def failed(house: House, door: Door, run: Callable[[str], dict[str, Any]]) -> str:
    """The job fails; the service says why."""
    del door
    house.failed = True
    found = run("wait")
    if "got" in found:
        return f"returns normally, status `{found['got']}`"
    told = "the reason is in it" if REASON in found["said"] else "without the reason"
    return f"`{found['raised']}`, {told}"


def broken(house: House, door: Door, run: Callable[[str], dict[str, Any]]) -> str:
    """A download of 24 MB breaks off in its middle, once."""
    del door
    house.cut = 1
    found = run("fetch")
    whole = found.get("got") == str(SIZE)
    how = "whole" if whole else f"{int(found['got']) / 1e6:.1f} MB, as if it were whole" if "got" in found else ""
    return f"{how or ending(found)}; {house.served / 1e6:.0f} MB sent in all"


def flipped(house: House, door: Door, run: Callable[[str], dict[str, Any]]) -> str:
    """One bit of the download is wrong."""
    del door
    house.wrong = True
    found = run("fetch")
    return "taken as it is" if "got" in found else f"`{found['raised']}`"


def lost(house: House, door: Door, run: Callable[[str], dict[str, Any]]) -> str:
    """The job is made, and the answer that says so is lost."""
    del door
    house.lose = True
    found = run("lost")
    knows = "the caller has its id" if "got" in found else f"`{found['raised']}`, the caller does not know of it"
    return f"{house.made} job; {knows}"


def token(house: House, door: Door, run: Callable[[str], dict[str, Any]]) -> str:
    """A second client without a token, in a process where a first one has one."""
    del door
    run("token")
    return "sends the first one's" if "first-secret" in house.tokens[-1] else "sends none"


def memory(house: House, door: Door, run: Callable[[str], dict[str, Any]]) -> str:
    """A file of 24 MB is sent: growth of the client's memory."""
    del house, door
    found = run("submit")
    return f"{found['grown_mb']:.0f} MB" if "got" in found else ending(found)


TRIALS = (away, busy, failed, lost, broken, flipped, memory, token)


def main(other: str) -> None:
    rng = np.random.default_rng(0)
    content = rng.integers(0, 256, SIZE, np.uint8).tobytes()
    print(f"| what happens | {' | '.join(CLIENTS)} |\n|{'---|' * (len(CLIENTS) + 1)}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "input.npz"
        file.write_bytes(content)
        for trial in TRIALS:
            row = []
            for client in CLIENTS:
                with serving(content) as (house, door):
                    row.append(trial(house, door, lambda wish, c=client, d=door: ask(other, c, wish, d, file)))
            print(f"| {trial.__doc__} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--other", required=True, metavar="PYTHON", help="An interpreter that has pyodm and replicate.")
    main(parser.parse_args().other)

"""A running service, forms and worker steps for tests of the service."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
import numpy as np
import uvicorn
from crafting import npz
from fastapi import FastAPI
from pliant.schemas.job import Artifact, Job
from pliant.service.settings import ServiceSettings
from pliant.worker.jobs import lifecycle
from pliant.worker.jobs.finished import Finished
from pliant.worker.jobs.service import Jobs
from pliant.worker.tokens import Scope, Tokens

NOW = datetime(2026, 5, 4, 9, 30, tzinfo=UTC)


@dataclass(frozen=True)
class Running:
    """A running service and its parts."""

    url: str
    jobs: Jobs
    settings: ServiceSettings
    server: uvicorn.Server
    tokens: Tokens
    app: FastAPI

    @property
    def left_on_disk(self) -> list[Path]:
        """Everything in the incoming folder but the process's own lock and empty folder.

        Entries that vanish meanwhile are not counted; `Path.rglob` would raise.
        """
        held = [Path(folder, name) for folder, *names in os.walk(self.jobs.settings.incoming) for name in chain(*names)]
        return [path for path in held if len(path.relative_to(self.jobs.settings.incoming).parts) > 1]

    def client(self, *scopes: Scope, name: str = "somebody", **more: Any) -> httpx.Client:
        """Return a client with a new token of its own."""
        _, text = self.tokens.create(name, scopes=scopes or (Scope.READ, Scope.SUBMIT), **more)
        return httpx.Client(base_url=self.url, timeout=20, headers={"Authorization": f"Bearer {text}"})

    @property
    def waiting(self) -> int:
        """Number of jobs."""
        return len(self.jobs.page(limit=200).jobs)


Serve = Callable[..., Running]


def settings_from(**env: str) -> ServiceSettings:
    """Read the settings of the service with these `PLIANT_` variables set, and no others."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PLIANT_")}
    given = {f"PLIANT_{name}": value for name, value in env.items()}
    with mock.patch.dict(os.environ, kept | given, clear=True):
        return ServiceSettings.from_environment()


def until(holds: Callable[[], Any], *, seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, "it did not come to hold in time"
        time.sleep(0.01)


def free_port() -> int:
    """Return a TCP port that is currently free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def heard(connection: socket.socket, words: bytes) -> bytes:
    """Read a response, in however many pieces, until it contains these words; fail if it ends without them."""
    answer = b""
    while words not in answer:
        piece = connection.recv(65536)
        assert piece, answer
        answer += piece
    return answer


def tracks(num_frames: int = 6, num_points: int = 12, *, seed: int = 0) -> bytes:
    return npz(tracks=np.random.default_rng(seed).normal(size=(num_frames, num_points, 2)) * 100)


def form(body: bytes | None = None, **parts: Any) -> dict[str, Any]:
    """Return httpx's `files` for a form: bytes become files, everything else text."""
    given = {"tracks": tracks() if body is None else body, **parts}
    return {
        name: (f"{name}.npz", value)
        if isinstance(value, bytes)
        else (None, value if isinstance(value, str) else json.dumps(value))
        for name, value in given.items()
    }


def submit(http: httpx.Client, **parts: Any) -> Job:
    answer = http.post("/v1/jobs", files=form(**parts))
    assert answer.status_code == 202, answer.text
    return Job.model_validate_json(answer.content)


def claim(running: Running, id: str) -> str:
    attempt_id = running.jobs.records.get(id).attempt_id
    running.jobs.records.update(id, lambda stored: lifecycle.claim(stored, attempt_id=attempt_id, worker="w", now=NOW))
    return attempt_id


def finish(running: Running, id: str, contents: bytes, *, name: str = "shapes.npz") -> None:
    """Act as a worker: claim the job, store a file, publish it."""
    attempt_id = claim(running, id)
    file = running.jobs.settings.data / f"{id}.tmp"
    file.write_bytes(contents)
    prefix = f"jobs/{id}/{attempt_id}/"
    running.jobs.blobs.put(f"{prefix}{name}", file)
    artifact = Artifact(
        name=name, media_type="application/octet-stream", bytes=len(contents), sha256=sha256(contents).hexdigest()
    )
    running.jobs.records.update(
        id,
        lambda stored: lifecycle.succeed(
            stored, Finished(metrics={}, outcome="converged", sentence="Converged.", warnings=(), artifacts=(artifact,)),
            attempt_id=attempt_id, prefix=prefix, now=NOW, retention=0,
        ),
    )  # fmt: skip

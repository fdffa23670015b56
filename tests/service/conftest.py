"""The whole service on a free port, with a real embedded Valkey and a real blob directory."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
import uvicorn
from pliant.service.app import create_app
from pliant.service.settings import ServiceSettings
from pliant.worker.formats import Limits
from pliant.worker.jobs.service import Jobs
from pliant.worker.processes.valkey import Valkey
from pliant.worker.settings import Settings
from pliant.worker.tokens import Tokens
from serving import Running, Serve, until


@pytest.fixture(scope="session")
def valkey_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    data = tmp_path_factory.mktemp("valkey")
    valkey = Valkey.claim(data)
    server = valkey.start()
    yield Settings(data=data).redis
    server.terminate()
    server.wait(10)
    valkey.release()


@pytest.fixture(scope="module")
def serve(valkey_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serve]:
    """Start services with custom settings; they stop with the module."""
    started: list[tuple[uvicorn.Server, threading.Thread]] = []

    def start(
        *,
        limits: Limits = Limits(),  # noqa: B008
        redis_url: str = valkey_url,
        quota: int = 0,
        blob_url: str | None = None,
        **given: Any,
    ) -> Running:
        data = tmp_path_factory.mktemp("data")
        queue = f"test-{secrets.token_hex(4)}"
        jobs = Jobs.open(Settings(data=data, redis_url=redis_url, blob_url=blob_url, queue=queue, disk_quota=quota))
        settings = ServiceSettings(port=0, **given)
        tokens = Tokens.open(jobs.settings)
        app = create_app(jobs, settings, tokens=tokens, limits=limits)
        server = uvicorn.Server(
            uvicorn.Config(app, port=0, log_config=None, server_header=False, timeout_graceful_shutdown=3)
        )
        thread = threading.Thread(target=server.run)
        thread.start()
        started.append((server, thread))
        until(lambda: server.started)
        port = server.servers[0].sockets[0].getsockname()[1]
        return Running(f"http://127.0.0.1:{port}", jobs, settings, server, tokens, app)

    yield start
    for server, _ in started:
        server.should_exit = True
    for _, thread in started:
        thread.join(10)


@pytest.fixture(scope="module")
def running(serve: Serve) -> Running:
    return serve()


@pytest.fixture(scope="module")
def guarded(serve: Serve) -> Running:
    """A service that requires tokens."""
    return serve(auth="required")


@pytest.fixture
def http(running: Running) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=running.url, timeout=20) as client:
        yield client

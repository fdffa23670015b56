"""Fixtures for several folders: one real service, started once, with its queue and one worker, and an S3 server."""

from __future__ import annotations

import functools
import gc
import os
import secrets
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import certifi
import pytest
import typer.testing

if TYPE_CHECKING:
    from forked import Forks

NANIO = shutil.which("nanio", path=f"{sysconfig.get_path('scripts')}:{Path(sys.executable).parent}")
"""A small S3 server."""

# A shell that starts the tests in the background makes them ignore SIGINT, and every process they start inherits that. The tests
# send SIGINT on purpose.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# An HTTP client reads the whole bundle of certificate authorities when it opens, which takes as long as a request. No test needs
# the bundle: tests that use TLS bring their own certificate.
AUTHORITY = tempfile.NamedTemporaryFile(suffix=".pem")  # noqa: SIM115 - as long as the process
AUTHORITY.write(
    certifi.contents().partition("-----END CERTIFICATE-----\n")[0].encode() + b"-----END CERTIFICATE-----\n"
)
AUTHORITY.flush()
certifi.where = lambda: AUTHORITY.name


BUNDLE, create_default_context = os.environ.get("SSL_CERT_FILE"), ssl.create_default_context
"""The variable has priority, and stays: processes that install packages need it."""


def with_one_authority(*purpose: ssl.Purpose, cafile: str | None = None, **others: Any) -> ssl.SSLContext:
    return create_default_context(*purpose, cafile=AUTHORITY.name if cafile and cafile == BUNDLE else cafile, **others)


ssl.create_default_context = with_one_authority

# Typer rebuilds all commands whenever a test invokes one.
typer.testing._get_command = functools.cache(typer.testing._get_command)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Load the tests without garbage collections, and leave what is loaded out of later ones: each would take half a second."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.collect()
        gc.freeze()


@pytest.fixture
def no_variables(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Remove the variables of Pliant, and move into an empty folder."""
    for name in [name for name in os.environ if name.startswith("PLIANT_")]:
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module", autouse=True)
def closed_connections() -> Iterator[None]:
    """Close the connections to Redis that a module has opened: otherwise they are collected, perhaps a socket before its connection."""
    import redis

    pools: list[redis.ConnectionPool] = []

    class Kept(redis.ConnectionPool):
        def __init__(self, *given: Any, **settings: Any) -> None:
            super().__init__(*given, **settings)
            pools.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("redis.client.ConnectionPool", Kept)
        yield
    for pool in pools:
        pool.disconnect(inuse_connections=False)  # others may still be used by fixtures of the session


@pytest.fixture(scope="session")
def service_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a running service; its jobs compute with one thread, so that their arrays can be compared bit for bit."""
    from pliant.cli.demo import running

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PLIANT_THREADS", "1")
        with running(tmp_path_factory.mktemp("service")) as url:
            yield url


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """A process that has loaded what readers need."""
    import forked

    with forked.forks() as made:
        yield made


@pytest.fixture
def forked_readers(forks: Forks, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files and films in processes that are forked instead of started."""
    import forked

    forked.use(forks, monkeypatch)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 3 MB."""
    disk = tmp_path / "small"
    disk.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(disk)], check=False, capture_output=True
    )
    if made.returncode != 0:
        pytest.skip("may not mount a small file system here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.fixture(scope="session")
def s3_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """URL of a bucket on a small local S3 server that checks its credentials."""
    if NANIO is None:
        pytest.skip("no S3 server here: pip install nanio")
    folder = tmp_path_factory.mktemp("s3")
    (folder / "bucket").mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    key, secret = "test", secrets.token_hex(8)
    command = [NANIO, "serve", "--data-dir", str(folder), "--host", "127.0.0.1", "--port", str(port)]
    env = {**os.environ, "NANIO_ACCESS_KEY": key, "NANIO_SECRET_KEY": secret}
    server = subprocess.Popen([*command, "--no-access-log", "--log-level", "error"], env=env)
    variables = {
        "AWS_ACCESS_KEY_ID": key, "AWS_SECRET_ACCESS_KEY": secret, "AWS_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ALLOW_HTTP": "true",
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        deadline = time.monotonic() + 20
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield "s3://bucket/prefix"
    server.terminate()
    server.wait(10)

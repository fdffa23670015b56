"""Benchmarks that start processes explain themselves without starting any, and end them when they are interrupted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
STARTING = ["figures.trace", "installation.hang"]


def command(module: str, *arguments: str) -> list[str]:
    return [sys.executable, "-m", f"benchmarks.{module}", *arguments]


def naming(folder: Path, *, within: str = "cmdline") -> list[str]:
    """Return the command lines of all processes that name a folder in their command line or, within `environ`, their environment."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if os.fsencode(folder) in (path / within).read_bytes():
                found.append((path / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        except OSError:
            continue
    return found


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A folder whose path leaves room for that of a socket, which has at most 107 characters."""
    with TemporaryDirectory(prefix="pliant-") as folder:
        yield Path(folder)


@pytest.mark.parametrize(
    "module",
    [
        *(pytest.param(each, marks=pytest.mark.long) for each in STARTING),
        "installation.cost",
        "accuracy.changed_constant",
    ],
)
def test_help_starts_nothing(module: str, tmp_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    ran = subprocess.run(
        command(module, "--help"), cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60, check=True
    )
    assert ran.stdout.startswith("usage: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
@pytest.mark.parametrize("module", STARTING)
def test_an_interrupted_benchmark_ends_what_it_started(module: str, number: int, short_path: Path) -> None:
    environment = {**os.environ, "TMPDIR": str(short_path)}
    with subprocess.Popen(
        command(module), cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        # Programs that a shell runs in the background, such as this test, ignore SIGINT, and so do those that they start.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    ) as process:  # fmt: skip
        try:
            while not naming(short_path) and process.poll() is None:
                time.sleep(0.05)
            assert naming(short_path), process.communicate()[1]
            process.send_signal(number)
            process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode != 0
    until = time.monotonic() + 30
    while naming(short_path, within="environ") and time.monotonic() < until:
        time.sleep(0.05)  # processes that end after the one that started them
    assert naming(short_path, within="environ") == naming(short_path) == []

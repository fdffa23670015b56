"""The service is killed and restarted; waiting and downloading clients continue."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from pliant.cli.demo import read_address
from pliant.client import Client, Job, Retry, Status
from pliant.solver.gallery import face

PATIENT = Retry(shortest_pause=0.1, longest_pause=0.5)


class Installation:
    """`pliant up` on one data directory, to be killed and started again at the same address."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = 0
        self.process: subprocess.Popen[str] | None = None
        self.url = self.start()
        self.port = int(self.url.rpartition(":")[2])

    def start(self) -> str:
        """Start it, retrying as a service manager does: children of a killed process may hold the port for a moment."""
        command = [sys.executable, "-m", "pliant.cli", "up", "--json", "--port", str(self.port)]
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            with (self.folder / "log").open("ab") as log:
                self.process = subprocess.Popen(
                    [*command, "--data", str(self.folder / "data")],
                    env={**os.environ, "PLIANT_STOP_GRACE": "0"},  # no job finishes after everything was killed
                    stdout=subprocess.PIPE, stderr=log, text=True,
                )  # fmt: skip
            assert self.process.stdout is not None
            url = read_address(self.process.stdout)
            if url is not None:
                return url
            self.end()
        raise AssertionError((self.folder / "log").read_text())

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.end()

    def stop(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGTERM)
        self.end()

    def end(self) -> None:
        assert self.process is not None
        self.process.wait(60)
        assert self.process.stdout is not None
        self.process.stdout.close()

    def service_pid(self) -> int:
        """Return the API process, which the supervisor restarts."""
        assert self.process is not None
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                command = (entry / "cmdline").read_bytes()
            except (FileNotFoundError, ProcessLookupError):
                continue
            if parent == self.process.pid and b"pliant.service" in command:
                return int(entry.name)
        raise AssertionError("no service")


@pytest.fixture(scope="module")
def installation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    installation = Installation(tmp_path_factory.mktemp("installation"))
    yield installation
    installation.stop()


@pytest.fixture
def killing(installation: Installation) -> Iterator[Callable[[str], None]]:
    """Kill `everything` and restart it as a service manager would, or only the `service`, which its supervisor restarts."""
    restarts: list[threading.Thread] = []

    def kill(what: str) -> None:
        if what == "service":
            os.kill(installation.service_pid(), signal.SIGKILL)
            return
        installation.kill()
        restarts.append(threading.Thread(target=installation.start))
        restarts[-1].start()

    yield kill
    for restart in restarts:
        restart.join(60)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the service's process through /proc")
@pytest.mark.parametrize("what", ["everything", pytest.param("service", marks=pytest.mark.long)])
def test_the_client_survives_a_killed_service_while_waiting_and_downloading(
    installation: Installation, killing: Callable[[str], None], tmp_path: Path, what: str
) -> None:
    sequence = face(60, 8000)
    # Known cameras and few reweightings: a large result soon, but not before anything can be killed.
    options = {"prior": "smooth+low_rank", "max_reweightings": 8, "tolerance": 1e-12}
    with Client(installation.url, retries=PATIENT) as client:
        job = client.submit(sequence.tracks.points, mesh="none", rotations=sequence.rotations, options=options)
        seen: list[Status] = []

        def kill_in_mid_wait(now: Job) -> None:
            if now.status is Status.RUNNING and Status.RUNNING not in seen:
                killing(what)
            seen.append(now.status)

        result = job.wait(on_progress=kill_in_mid_wait, load=False, timeout=120)
        assert result.job.status is Status.SUCCEEDED
        assert Status.RUNNING in seen
        assert (result.job.attempt > 1) == (what == "everything")

        size = next(artifact.bytes for artifact in result.job.artifacts if artifact.name == "shapes.npz")
        assert size > 10_000_000  # more than the sockets' buffers hold, so that the connection breaks mid-file
        killed: list[int] = []

        def kill_in_mid_download(done: int, total: int) -> None:
            if len(killed) == 0:
                killing(what)
                killed.append(done)

        paths = result.download(tmp_path / "out", names=["shapes.npz"], on_download=kill_in_mid_download, timeout=120)
        assert 0 < killed[0] < size
    with np.load(paths["shapes.npz"]) as held:
        assert held["shapes"].shape == sequence.shapes.shape

"""An installation, `pliant up` in separate processes, whose stores can be read and whose processes can be killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

from pliant.client import Client, Job, Retry
from pliant.service.spool import Incoming
from pliant.worker.errors import StoreUnavailable
from pliant.worker.jobs.service import Jobs
from pliant.worker.maintenance.fsck import findings
from pliant.worker.processes.containment import die_with_parent
from pliant.worker.settings import Settings

SOON = Settings(lost_after=2, stop_grace=1, cancel_grace=3, threads=1, max_attempts=1000)
"""Settings with which faults are detected within seconds."""

PATIENT = Retry(first_contact=60, shortest_pause=0.05, longest_pause=0.5)

ROLES = {"service": b"pliant.service", "worker": b"pliant.worker\0work", "reconciler": b"pliant.worker\0reconcile"}


@dataclass
class Instance:
    """`pliant up` on one data directory, as a context manager; `start` after `kill_all` or `stop` reuses the port."""

    folder: Path
    chosen: Settings = SOON
    of_service: Mapping[str, str] = field(default_factory=dict)
    """Additional environment variables of `pliant up`."""
    workers: int = 2
    port: int = 0
    url: str = ""
    acknowledged: list[str] = field(default_factory=list)
    """Ids of all accepted jobs."""
    seen: set[int] = field(default_factory=set)
    """Ids of all processes that were observed."""
    _process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Instance:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.look()
        self.stop()
        alive = [pid for pid in self.seen if running(pid)]
        assert not alive, f"processes left behind: {alive}"

    @property
    def settings(self) -> Settings:
        """Settings of the installation."""
        return replace(self.chosen, data=self.folder / "data")

    @cached_property
    def jobs(self) -> Jobs:
        """The jobs, read directly from the stores."""
        return Jobs.open(self.settings)

    def client(self) -> Client:
        """Return a client that waits while the service restarts."""
        return Client(self.url, retries=PATIENT)

    def start(self) -> None:
        """Start `pliant up`; retry while children of a killed instance still hold the port or the data directory."""
        command = [sys.executable, "-m", "pliant.cli", "up", "--json", "--port", str(self.port)]
        command += ["--data", str(self.folder / "data"), "--workers", str(self.workers)]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PLIANT_")}
        environment |= {**self.settings.to_environment(), **self.of_service}
        self.folder.mkdir(parents=True, exist_ok=True)
        deadline = time.monotonic() + 90
        while time.monotonic() < deadline:
            with (self.folder / "log").open("ab") as log:
                self._process = subprocess.Popen(
                    command, env=environment, stdout=subprocess.PIPE, stderr=log, text=True,
                    preexec_fn=partial(die_with_parent, os.getpid(), how=signal.SIGTERM),
                )  # fmt: skip
            assert self._process.stdout is not None
            text = ""
            for line in self._process.stdout:
                text += line
                if line.rstrip() == "}":
                    self.url = json.loads(text)["url"]
                    self.port = int(self.url.rpartition(":")[2])
                    self.look()
                    return
            self._end()
        raise AssertionError((self.folder / "log").read_text()[-3000:])

    def stop(self) -> None:
        """Send SIGTERM to the supervisor, as a service manager does, and wait for its end."""
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._end()

    def kill_all(self) -> None:
        """Send SIGKILL to the supervisor, whose children end with it."""
        self.look()
        assert self._process is not None
        self._process.kill()
        self._end()

    def _end(self) -> None:
        assert self._process is not None
        self._process.wait(90)
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._process = None

    def look(self) -> dict[str, list[int]]:
        """Return process ids by role, including `job process`."""
        assert self._process is not None
        found: dict[str, list[int]] = {role: [] for role in (*ROLES, "valkey", "job process")}
        for pid in children(self._process.pid):
            command = command_of(pid)
            role = next((role for role, words in ROLES.items() if words in command), "valkey")
            found[role].append(pid)
        found["job process"] = [pid for worker in found["worker"] for pid in children(worker)]
        self.seen |= {pid for pids in found.values() for pid in pids}
        return found

    def kill(self, role: str, number: signal.Signals = signal.SIGKILL) -> int:
        """Signal one process of a role, waiting until there is one; return its id."""
        seen: list[int] = []

        def there() -> bool:
            seen[:] = self.look()[role]  # look once: the process may end before a second look
            return bool(seen)

        self.until(there, f"there is a {role}")
        pid = seen[0]
        os.kill(pid, number)
        return pid

    def until(self, holds: Callable[[], object], what: str, *, seconds: float = 60.0) -> float:
        """Wait until `holds()` is true, retrying while a store is unavailable; return the seconds taken."""
        began = time.monotonic()
        while True:
            try:
                if holds():
                    return time.monotonic() - began
            except StoreUnavailable:
                pass
            assert time.monotonic() - began < seconds, f"not within {seconds:g} s: {what}"
            time.sleep(0.01)

    def midst(self, id: str, *stages: str, seconds: float = 60.0) -> str:
        """Wait until a job is in one of these stages or has ended; return its stage or status."""

        def there() -> bool:
            job = self.jobs.get(id)
            return job.status.final or (job.progress is not None and job.progress.stage in stages)

        self.until(there, f"job {id} is in {stages}", seconds=seconds)
        job = self.jobs.get(id)
        return job.progress.stage if job.progress is not None and not job.status.final else job.status.value

    def final(self, id: str, *, seconds: float = 120.0) -> Job:
        """Wait until a job ends; return it."""
        self.until(lambda: self.jobs.get(id).status.final, f"job {id} ends", seconds=seconds)
        return self.jobs.get(id)

    def misfits(self, *, seconds: float = 60.0) -> list[str]:
        """Return what is lost, duplicated, half-written or left over, after up to `seconds` for cleaning up."""
        deadline = time.monotonic() + seconds
        while True:
            found = self._misfits()
            if not found or time.monotonic() > deadline:
                return found
            time.sleep(0.5)

    def _misfits(self) -> list[str]:
        jobs = self.jobs
        listed, cursor = [], None
        while True:
            page = jobs.page(limit=200, cursor=cursor)
            listed += [job.id for job in page.jobs]
            cursor = page.next
            if cursor is None:
                break
        found = [f"Job {id} is lost." for id in set(self.acknowledged) - set(listed)]
        found += [f"Job {id} was never acknowledged." for id in set(listed) - set(self.acknowledged)]
        found += [f"Job {id} is there twice." for id in {id for id in listed if listed.count(id) > 1}]
        found += [
            f"Folder incoming/{name} is left." for name in Incoming(self.folder / "data" / "incoming").abandoned()
        ]
        found += [f"Upload {path.name} is left." for path in self.settings.uploads.glob("*/*")]
        found += [f"Job process {pid} has nothing to do." for pid in self.look()["job process"] if not self._at_work()]
        return found + findings(jobs, pause=0.3)

    def _at_work(self) -> bool:
        return any(not job.status.final for job in self.jobs.page(limit=200).jobs)


def children(parent: int) -> list[int]:
    """Return the ids of child processes that are not zombies."""
    found: list[int] = []
    with suppress(OSError):  # it has ended
        for task in Path(f"/proc/{parent}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    return [child for child in found if running(child)]


def running(pid: int) -> bool:
    """Return whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def resident(pid: int) -> int:
    """Return the resident memory of a process in bytes, shared pages included."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def command_of(pid: int) -> bytes:
    """Return the arguments of a process, each with a zero byte after it; empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""

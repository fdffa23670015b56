"""An installation on five hosts: one with two API processes and the reconciler, two with a worker each, one with Valkey, one with S3."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from crafting import npy
from long_jobs import LONG, long_sequence
from network import Network
from pliant.worker.processes.containment import die_with_parent
from pliant.worker.processes.valkey import find_binary

from benchmarks.installation.instance import children, command_of, running

WORKER_HOSTS = ("one", "two")
HOSTS = ("front", *WORKER_HOSTS, "valkey", "s3")
SHORT_TIMERS = {
    "PLIANT_LOST_AFTER": "2", "PLIANT_STOP_GRACE": "1", "PLIANT_CANCEL_GRACE": "1", "PLIANT_THREADS": "1",
    "PLIANT_MAX_ATTEMPTS": "100", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PLIANT_AUTH": "off",
    "PLIANT_LOG_LEVEL": "info", "PLIANT_LOG_FORMAT": "json",
}  # fmt: skip


class Hosts:
    """Processes that run inside `with`, each on its host; none may be left behind."""

    def __init__(self, folder: Path, network: Network) -> None:
        self.folder, self.network = folder, network
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        password, key, secret = (secrets.token_hex(8) for _ in range(3))
        (folder / "s3" / "bucket").mkdir(parents=True)
        (folder / "valkey").mkdir()
        self._credentials = {"NANIO_ACCESS_KEY": key, "NANIO_SECRET_KEY": secret}
        at = network.address
        self._valkey = [
            str(find_binary()), "--bind", at["valkey"], "--port", "6379", "--requirepass", password, "--appendonly", "yes",
            "--appendfsync", "always", "--save", "", "--dir", str(folder / "valkey"), "--loglevel", "warning",
        ]  # fmt: skip
        self._s3 = [
            str(shutil.which("nanio", path=f"{sysconfig.get_path('scripts')}:{Path(sys.executable).parent}:{os.environ['PATH']}")),
            *("serve", "--data-dir", str(folder / "s3"), "--host", at["s3"], "--port", "9000", "--no-access-log"),
        ]  # fmt: skip
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("PLIANT_", "AWS_"))},
            **SHORT_TIMERS,
            "PLIANT_REDIS_URL": f"redis://:{password}@{at['valkey']}:6379/0",
            "PLIANT_BLOB_URL": "s3://bucket/pliant", "PLIANT_HOST": at["front"],
            "AWS_ACCESS_KEY_ID": key, "AWS_SECRET_ACCESS_KEY": secret, "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://{at['s3']}:9000", "AWS_ALLOW_HTTP": "true",
        }  # fmt: skip
        self.urls = [f"http://{at['front']}:{port}" for port in (8000, 8001)]
        self.http = httpx.Client(base_url=self.urls[0], timeout=20)
        self.acknowledged: list[str] = []
        sequence = long_sequence()
        self._files = {
            "tracks": ("tracks.npy", npy(sequence.tracks.points)),
            "rotations": ("rotations.npy", npy(sequence.rotations)),
        }

    def __enter__(self) -> Hosts:
        try:
            return self._begin()
        except BaseException:
            self.__exit__()
            raise

    def _begin(self) -> Hosts:
        self.start("valkey", "valkey", self._valkey)
        self.start("s3", "s3", self._s3, self._credentials)
        for name, port in (("api", "8000"), ("api2", "8001")):
            self.start(name, "front", [sys.executable, "-m", "pliant.service"], {"PLIANT_PORT": port})
        self.start("reconciler", "front", [sys.executable, "-m", "pliant.worker", "reconcile"])
        for host in WORKER_HOSTS:
            self.start_workers(host)
        for url in self.urls:
            self.until(lambda url=url: self.answers(f"{url}/readyz"), "every part answers", seconds=90)  # type: ignore[misc]
        self.until(lambda: self.workers() == len(WORKER_HOSTS), "both workers are there", seconds=60)
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()
        pids = [pid for name in self._processes for pid in self.tree(name)]
        for name in ("one", "two", "reconciler", "api", "api2", "s3", "valkey"):
            if name in self._processes:
                self._processes[name].send_signal(signal.SIGCONT)
                self._processes[name].terminate()
        for process in self._processes.values():
            process.wait(30)
        assert [pid for pid in pids if running(pid)] == [], "processes left behind"

    def start(self, name: str, host: str, argv: list[str], more: Mapping[str, str] | None = None) -> None:
        """Start a process on a host."""
        environment = {**self.environment, "PLIANT_DATA": str(self.folder / host / "data"), **(more or {})}
        with (self.folder / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                self.network.command(host, argv), env=environment, stdout=log, stderr=log, start_new_session=True,
                preexec_fn=partial(die_with_parent, os.getpid(), how=signal.SIGTERM),
            )  # fmt: skip

    def start_workers(self, host: str, more: Mapping[str, str] | None = None) -> None:
        """Start a worker, and a reconciler beside it, on a host."""
        self.start(host, host, [sys.executable, "-m", "pliant.cli", "work"], more)

    def restart(self, name: str) -> None:
        """Start Valkey, S3 or the first API process again."""
        if name == "valkey":
            self.start("valkey", "valkey", self._valkey)
        elif name == "api":
            self.start("api", "front", [sys.executable, "-m", "pliant.service"], {"PLIANT_PORT": "8000"})
        else:
            self.start("s3", "s3", self._s3, self._credentials)

    def tree(self, name: str) -> list[int]:
        """Return a process and everything it started."""
        found, new = [], [self._processes[name].pid]
        while new:
            found += new
            new = [child for pid in new for child in children(pid)]
        return found

    def signal(self, name: str, number: signal.Signals) -> None:
        """Signal a process and everything it started; wait for those that are killed."""
        for pid in [self._processes[name].pid] if number is signal.SIGTERM else self.tree(name):
            os.kill(pid, number)
        if number in (signal.SIGKILL, signal.SIGTERM):
            self._processes[name].wait(30)

    def host_of(self, id: str) -> str:
        """Wait until the solver runs the job, and return the host whose worker has a job process."""
        self.until(lambda: (self.get(id).get("progress") or {}).get("reweighting", 0) > 0, "it solves", seconds=40)
        found = [host for host in WORKER_HOSTS if self.job_process(host)]
        assert len(found) == 1, found
        return found[0]

    def job_process(self, host: str) -> list[int]:
        """Return the job process on a host."""
        workers = [pid for pid in self.tree(host) if b"pliant.worker\0work" in command_of(pid)]
        return [child for pid in workers for child in children(pid)]

    def tracks(self) -> bytes:
        """Return the tracks of the jobs, as a file's bytes."""
        return self._files["tracks"][1]

    def submit(self, *, reweightings: int = 1000, url: str = "", upload: str = "", **more: Any) -> str:
        """Submit a job that lasts for so many reweightings, with these tracks or those of an upload; return its id."""
        options = {**LONG, "max_reweightings": reweightings, "outputs": []}
        tracks = {"tracks_upload": (None, upload)} if upload else {"tracks": self._files["tracks"]}
        files = {
            **tracks,
            "rotations": self._files["rotations"],
            "mesh": (None, "none"),
            "options": (None, json.dumps(options)),
        }
        answer = self.http.post(f"{url or self.urls[0]}/v1/jobs", files=files, **more)
        answer.raise_for_status()
        id = str(answer.json()["id"])
        if id not in self.acknowledged:
            self.acknowledged.append(id)
        return id

    def get(self, id: str) -> dict[str, Any]:
        """Return a job, or an empty dict while the service does not answer."""
        try:
            answer = self.http.get(f"/v1/jobs/{id}")
        except httpx.TransportError:
            return {}
        return dict(answer.json()) if answer.status_code == 200 else {}

    def answers(self, url: str) -> bool:
        """Return True if the address returns 200."""
        try:
            return self.http.get(url).status_code == 200
        except httpx.TransportError:
            return False

    def workers(self) -> int:
        """Return how many workers have a recent heartbeat."""
        text = self.http.get("/metrics").text
        return int(
            float(next(line.split()[1] for line in text.splitlines() if line.startswith("pliant_workers_alive ")))
        )

    def until(self, condition: Callable[[], object], what: str, *, seconds: float = 30.0) -> float:
        """Wait for a condition; return the seconds it took."""
        began = time.monotonic()
        while not condition():
            assert time.monotonic() - began < seconds, f"not within {seconds} s: {what}\n{self.tail()}"
            time.sleep(0.03)
        return time.monotonic() - began

    def final(self, id: str, *, seconds: float = 60.0) -> dict[str, Any]:
        """Wait for the end of a job."""
        self.until(
            lambda: self.get(id).get("status") in ("succeeded", "failed", "cancelled"), "the job ends", seconds=seconds
        )
        return self.get(id)

    def cancelled(self, id: str) -> None:
        """Cancel a job and wait for its end."""
        self.http.post(f"/v1/jobs/{id}/cancel")
        assert self.final(id)["status"] == "cancelled"

    def misfits(self) -> dict[str, list[str]]:
        """Return the jobs that are lost, those that exist without an acknowledgement, and what is left over in the end."""
        found = [f"working files on {host}: {self.at_work(host)}" for host in WORKER_HOSTS if not self._cleared(host)]
        fsck = subprocess.run(
            self.network.command("front", [sys.executable, "-m", "pliant.cli", "fsck"]),
            env={**self.environment, "PLIANT_DATA": str(self.folder / "front" / "data")}, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        if fsck.returncode != 0:
            found.append(fsck.stdout.strip() or fsck.stderr.strip())
        listed = {job["id"] for job in self.http.get("/v1/jobs", params={"limit": 200}).json()["jobs"]}
        acknowledged = set(self.acknowledged)
        return {"lost": sorted(acknowledged - listed), "duplicated": sorted(listed - acknowledged), "left over": found}

    def at_work(self, host: str) -> list[str]:
        """Return the scratch directories on a host."""
        work = self.folder / host / "data" / "work"
        return [path.name for path in work.iterdir()] if work.exists() else []

    def blobs(self, id: str) -> list[str]:
        """Return the files that S3 holds for a job."""
        stored = [path for path in (self.folder / "s3" / "bucket").rglob("*") if path.is_file() and id in str(path)]
        noted = {f"{path.name}.json" for path in stored}  # nanio's metadata of each file
        return sorted(path.name for path in stored if path.name not in noted)

    def tail(self) -> str:
        """Return the last lines of every log."""
        return "\n".join(
            f"== {log.name}\n{log.read_text(errors='replace')[-1500:]}" for log in sorted(self.folder.glob("*.log"))
        )

    def _cleared(self, host: str) -> bool:
        until = time.monotonic() + 8
        while self.at_work(host) and time.monotonic() < until:
            time.sleep(0.1)
        return not self.at_work(host)

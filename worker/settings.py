"""How the jobs' machinery is set up: one frozen record, read from the environment once and handed down by hand."""

from __future__ import annotations

import ipaddress
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pliant.worker.errors import InvalidSetting
from pliant.worker.paths import socket_path

NUMERICAL_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""What the numerical libraries read when they are loaded. Jobs set them to 1: the solver shares work among threads of its own, and
those of a linear-algebra library wait spinning, which ruins everybody on a busy machine (`benchmarks/README.md`)."""


CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""Where a container's share of the processors stands: `quota period` in microseconds, or `max period` (cgroup v2)."""


def usable_cores(quota: Path = CPU_QUOTA) -> int:
    """Cores this process may use: the affinity mask, where the system has one, and no more than its container's share."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        share, period = map(float, quota.read_text().split())
    except (OSError, ValueError):  # no such file, or "max": no limit
        return cores
    return max(1, min(cores, math.ceil(share / period)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Where things are kept, how many work at once, and how patient everybody is. All durations in seconds, sizes in bytes."""

    data: Path = Path("pliant-data")
    """Directory of everything that must survive: the embedded queue's log, blobs, working files."""

    redis_url: str | None = None
    """`redis://`, `rediss://` or `unix://` URL; None: the embedded Valkey of `data`."""

    blob_url: str | None = None
    """`file:///…` or `s3://bucket/prefix`; None: the directory `blobs` inside `data`."""

    queue: str = "pliant"
    """Name of the queue and prefix of every Redis key, so that two installations can share a server."""

    workers: int = 1
    """Jobs worked on at once."""

    threads: int | None = None
    """Threads of the numerical libraries in one job; None: the usable cores shared evenly among the workers."""

    time_limit: float = 3600.0
    """Longest time one attempt may take; 0: no limit."""

    memory_limit: int = 0
    """Address space one job may take; 0: no limit but the machine's. The libraries alone need half a gigabyte."""

    cancel_grace: float = 10.0
    """After a cancel or a passed time limit: how long the job may take to stop by itself before it is killed."""

    stop_grace: float = 10.0
    """After SIGTERM: how long a running job may go on before it is put back into the queue."""

    lost_after: float = 10.0
    """A running job whose worker gave no sign of life for this long is taken from it."""

    max_attempts: int = 3
    """How often a job is begun anew when workers vanish under it."""

    webhook_networks: str = ""
    """Networks (CIDR, commas between them) whose addresses webhooks may be sent to although they are private, link-local,
    loopback or otherwise not of the public internet."""

    max_running: int = 0
    """Jobs of one owner that are worked on at once, the others wait; 0: as many as there are workers. Where tokens are off,
    all jobs have one owner."""

    retention: float = 30 * 86400.0
    """How long a finished job and its files are kept; 0: for ever."""

    disk_quota: int = 0
    """Bytes all jobs together may hold before new ones are refused; 0: no quota."""

    read_memory: int = 8 << 30
    """Address space of the process that reads large inputs; what needs more is refused as too_large."""

    film_memory: int = 4 << 30
    """Address space of the process that decodes and tracks a film; what needs more is refused as too_large."""

    film_frames: int = 3600
    """Frames of one film that may be tracked."""

    film_pixels: int = 4096 * 2304
    """Width times height of a film."""

    film_seconds: float = 600.0
    """Playing time of a film up to the last frame that is tracked."""

    upload_expiry: float = 86400.0
    """How long an upload is kept after its last byte, or after the last job that used it; 0: for ever."""

    @classmethod
    def from_environment(cls, environment: Mapping[str, str]) -> Settings:
        """Read the `PLIANT_…` variables; one that is absent or empty leaves the default.

        Raises
        ------
        InvalidSetting
            A variable does not parse or is out of its range.
        """
        given: dict[str, Any] = {}
        for name, (variable, expected, parse) in VARIABLES.items():
            text = environment.get(variable, "")
            if not text:
                continue
            try:
                given[name] = parse(text)
            except ValueError:
                raise InvalidSetting(variable, expected=expected, got=text) from None
        return cls(**given)

    def to_environment(self) -> dict[str, str]:
        """Return the variables that `from_environment` reads back as this record: how child processes are told."""
        values = {variable: getattr(self, name) for name, (variable, _, _) in VARIABLES.items()}
        return {variable: str(value) for variable, value in values.items() if value is not None}

    @property
    def redis(self) -> str:
        """URL of the Redis to use, the embedded one's when none is given."""
        return self.redis_url or f"unix://{quote(str(socket_path(self.data)))}"

    @property
    def blobs(self) -> str:
        """URL of the blob store to use, a directory inside `data` when none is given."""
        return self.blob_url or (self.data.absolute() / "blobs").as_uri()

    @property
    def work(self) -> Path:
        """Directory of the running jobs' working files."""
        return self.data.absolute() / "work"

    @property
    def uploads(self) -> Path:
        """Directory of large inputs that no job has taken yet."""
        return self.data.absolute() / "uploads"

    @property
    def threads_per_job(self) -> int:
        """Threads the numerical libraries may use in one job."""
        return self.threads or max(1, usable_cores() // self.workers)


def _at_least(low: float, parse: Callable[[str], float]) -> Callable[[str], float]:
    def bounded(text: str) -> float:
        value = parse(text)
        if not low <= value < float("inf"):
            raise ValueError(text)
        return value

    return bounded


def _networks(text: str) -> str:
    return ",".join(str(ipaddress.ip_network(part.strip())) for part in text.split(",") if part.strip())


_ONE = ("a whole number, at least 1", _at_least(1, int))
_BYTES = ("a whole number of bytes, at least 0", _at_least(0, int))
_SECONDS = ("a number of seconds, at least 0", _at_least(0, float))

VARIABLES: dict[str, tuple[str, str, Callable[[str], Any]]] = {
    "data": ("PLIANT_DATA", "a path", Path),
    "redis_url": ("PLIANT_REDIS_URL", "a URL", str),
    "blob_url": ("PLIANT_BLOB_URL", "a URL", str),
    "queue": ("PLIANT_QUEUE", "a name", str),
    "workers": ("PLIANT_WORKERS", *_ONE),
    "threads": ("PLIANT_THREADS", *_ONE),
    "time_limit": ("PLIANT_TIME_LIMIT", *_SECONDS),
    "memory_limit": ("PLIANT_MEMORY_LIMIT", *_BYTES),
    "cancel_grace": ("PLIANT_CANCEL_GRACE", *_SECONDS),
    "stop_grace": ("PLIANT_STOP_GRACE", *_SECONDS),
    "lost_after": ("PLIANT_LOST_AFTER", "a number of seconds, at least 1", _at_least(1, float)),
    "max_attempts": ("PLIANT_MAX_ATTEMPTS", *_ONE),
    "webhook_networks": ("PLIANT_WEBHOOK_NETWORKS", "networks such as 10.0.0.0/8, commas between them", _networks),
    "max_running": ("PLIANT_MAX_RUNNING", "a whole number, at least 0", _at_least(0, int)),
    "retention": ("PLIANT_RETENTION", *_SECONDS),
    "disk_quota": ("PLIANT_DISK_QUOTA", *_BYTES),
    "read_memory": ("PLIANT_READ_MEMORY", "a whole number of bytes, at least 1 GiB", _at_least(1 << 30, int)),
    "film_memory": ("PLIANT_FILM_MEMORY", "a whole number of bytes, at least 512 MiB", _at_least(512 << 20, int)),
    "film_frames": ("PLIANT_FILM_FRAMES", "a whole number, at least 3", _at_least(3, int)),
    "film_pixels": ("PLIANT_FILM_PIXELS", "a whole number, at least 256", _at_least(256, int)),
    "film_seconds": ("PLIANT_FILM_SECONDS", "a number of seconds, at least 1", _at_least(1, float)),
    "upload_expiry": ("PLIANT_UPLOAD_EXPIRY", *_SECONDS),
}
"""Field, its environment variable, what is expected, how it is read."""

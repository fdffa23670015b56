"""Settings of the worker package: one frozen record, read from the environment once and passed explicitly."""

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
"""Environment variables of the numerical libraries. Jobs set them to 1: the solver uses its own threads, and those of BLAS busy-wait,
which slows down all processes on a loaded machine (`benchmarks/README.md`)."""


CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""File with a container's processor quota: `quota period` in microseconds, or `max period` (cgroup v2)."""


def usable_cores(quota: Path = CPU_QUOTA) -> int:
    """Return the number of cores this process may use, by its affinity mask and its container's quota."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        share, period = map(float, quota.read_text().split())
    except (OSError, ValueError):  # no such file, or "max": no limit
        return cores
    return max(1, min(cores, math.ceil(share / period)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Locations, concurrency and limits. Durations in seconds, sizes in bytes."""

    data: Path = Path("pliant-data")
    """Directory of all persistent data: the embedded queue's log, blobs, working files."""

    redis_url: str | None = None
    """`redis://`, `rediss://` or `unix://` URL; None: the embedded Valkey of `data`."""

    blob_url: str | None = None
    """`file:///…` or `s3://bucket/prefix`; None: the directory `blobs` inside `data`."""

    queue: str = "pliant"
    """Name of the queue and prefix of every Redis key, so that two installations can share a server."""

    workers: int = 1
    """Number of jobs that run at once."""

    threads: int | None = None
    """Threads of the numerical libraries in one job; None: the usable cores shared evenly among the workers."""

    time_limit: float = 3600.0
    """Time limit of one attempt; 0: no limit."""

    memory_limit: int = 0
    """Limit of a job's address space; 0: no limit. The libraries alone need half a gigabyte."""

    cancel_grace: float = 10.0
    """Time for a job to stop by itself after a cancellation or its time limit, before it is killed."""

    stop_grace: float = 10.0
    """Time for a running job to finish after SIGTERM, before it is requeued."""

    lost_after: float = 10.0
    """Time without heartbeats after which a running job is requeued."""

    max_attempts: int = 3
    """Maximum number of attempts at a job whose workers are lost."""

    webhook_networks: str = ""
    """Networks (CIDR, commas between them) whose addresses webhooks may be sent to although they are private, link-local,
    loopback or otherwise not of the public internet."""

    max_running: int = 0
    """Maximum number of running jobs per owner, the others wait; 0: no limit. Without tokens, all jobs have one owner."""

    retention: float = 30 * 86400.0
    """Time for which a finished job and its files are kept; 0: indefinitely."""

    disk_quota: int = 0
    """Total bytes of all jobs above which new ones are rejected; 0: no quota."""

    read_memory: int = 8 << 30
    """Limit of the address space of the process that reads large inputs; inputs that need more are rejected as too_large."""

    film_memory: int = 4 << 30
    """Address space of the process that decodes and tracks a film; what needs more is refused as too_large."""

    film_frames: int = 3600
    """Frames of one film that may be tracked."""

    film_pixels: int = 4096 * 2304
    """Width times height of a film."""

    film_seconds: float = 600.0
    """Playing time of a film up to the last frame that is tracked."""

    upload_expiry: float = 86400.0
    """Time for which an upload is kept after its last byte or its last use by a job; 0: indefinitely."""

    @classmethod
    def from_environment(cls, environment: Mapping[str, str]) -> Settings:
        """Read the `PLIANT_…` variables; absent or empty ones keep the default.

        Raises
        ------
        InvalidSetting
            A variable does not parse or is out of range.
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
        """Return the variables from which `from_environment` restores this record, for child processes."""
        values = {variable: getattr(self, name) for name, (variable, _, _) in VARIABLES.items()}
        return {variable: str(value) for variable, value in values.items() if value is not None}

    @property
    def redis(self) -> str:
        """URL of Redis: the given one, else that of the embedded server."""
        return self.redis_url or f"unix://{quote(str(socket_path(self.data)))}"

    @property
    def blobs(self) -> str:
        """URL of the blob store: the given one, else a directory inside `data`."""
        return self.blob_url or (self.data.absolute() / "blobs").as_uri()

    @property
    def work(self) -> Path:
        """Directory of the running jobs' working files."""
        return self.data.absolute() / "work"

    @property
    def uploads(self) -> Path:
        """Directory of uploads."""
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

"""How the jobs' machinery is set up: one frozen record, read from the environment once and handed down by hand."""

from __future__ import annotations

import ipaddress
import math
import os
from dataclasses import fields
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from pliant.worker.environment import read, variable_of
from pliant.worker.paths import socket_path
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

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


def _networks(text: str) -> str:
    return ",".join(str(ipaddress.ip_network(part.strip())) for part in text.split(",") if part.strip())


Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False, description="a number of seconds, at least 0")]
Bytes = Annotated[int, Field(ge=0, description="a whole number of bytes, at least 0")]
Networks = Annotated[
    str, AfterValidator(_networks), Field(description="networks such as 10.0.0.0/8, commas between them")
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Where things are kept, how many work at once, and how patient everybody is. All durations in seconds, sizes in bytes."""

    data: Path = Path("pliant-data")
    """Directory of everything that must survive: the embedded queue's log, blobs, working files."""

    redis_url: str | None = Field(None, description="a URL")
    """`redis://`, `rediss://` or `unix://` URL; None: the embedded Valkey of `data`."""

    blob_url: str | None = Field(None, description="a URL")
    """`file:///…` or `s3://bucket/prefix`; None: the directory `blobs` inside `data`."""

    queue: str = Field("pliant", description="a name")
    """Name of the queue and prefix of every Redis key, so that two installations can share a server."""

    workers: int = Field(1, ge=1)
    """Jobs worked on at once."""

    threads: int | None = Field(None, ge=1)
    """Threads of the numerical libraries in one job; None: the usable cores shared evenly among the workers."""

    time_limit: Seconds = 3600.0
    """Longest time one attempt may take; 0: no limit."""

    memory_limit: Bytes = 0
    """Address space one job may take; 0: no limit but the machine's. The libraries alone need half a gigabyte."""

    cancel_grace: Seconds = 10.0
    """After a cancel or a passed time limit: how long the job may take to stop by itself before it is killed."""

    stop_grace: Seconds = 10.0
    """After SIGTERM: how long a running job may go on before it is put back into the queue."""

    lost_after: float = Field(10.0, ge=1, allow_inf_nan=False, description="a number of seconds, at least 1")
    """A running job whose worker gave no sign of life for this long is taken from it."""

    max_attempts: int = Field(3, ge=1)
    """How often a job is begun anew when workers vanish under it."""

    webhook_networks: Networks = ""
    """Networks (CIDR, commas between them) whose addresses webhooks may be sent to although they are private, link-local,
    loopback or otherwise not of the public internet."""

    max_running: int = Field(0, ge=0)
    """Jobs of one owner that are worked on at once, the others wait; 0: as many as there are workers. Where tokens are off,
    all jobs have one owner."""

    retention: Seconds = 30 * 86400.0
    """How long a finished job and its files are kept; 0: for ever."""

    disk_quota: Bytes = 0
    """Bytes all jobs together may hold before new ones are refused; 0: no quota."""

    read_memory: int = Field(8 << 30, ge=1 << 30, description="a whole number of bytes, at least 1 GiB")
    """Address space of the process that reads large inputs; what needs more is refused as too_large."""

    upload_expiry: Seconds = 86400.0
    """How long an upload is kept after its last byte, or after the last job that used it; 0: for ever."""

    @classmethod
    def from_environment(cls) -> Settings:
        """Read the `PLIANT_…` variables, `.env` and the secret files: see `pliant.worker.environment.read`."""
        return read(cls)

    def to_environment(self) -> dict[str, str]:
        """Return the variables that `from_environment` reads back as this record: how child processes are told."""
        values = {variable_of(field.name): getattr(self, field.name) for field in fields(self)}
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
    def incoming(self) -> Path:
        """Directory of request bodies that are still arriving."""
        return self.data.absolute() / "incoming"

    @property
    def uploads(self) -> Path:
        """Directory of large inputs that no job has taken yet."""
        return self.data.absolute() / "uploads"

    @property
    def threads_per_job(self) -> int:
        """Threads the numerical libraries may use in one job."""
        return self.threads or max(1, usable_cores() // self.workers)

"""Settings of the worker package: one frozen record, read from the environment once and passed explicitly."""

from __future__ import annotations

import ipaddress
import math
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote

from pliant.schemas.film_limits import FilmLimits
from pliant.worker.control_group import group_files
from pliant.worker.environment import read, variable_of
from pliant.worker.paths import socket_path
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass


def usable_cores(quotas: Sequence[Path] | None = None) -> int:
    """Return the number of cores this process may use, by its affinity mask and the quotas of container and systemd unit.

    They are in the files `quotas`: `quota period` in microseconds, or `max period`.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for file in group_files("cpu.max") if quotas is None else quotas:
        with suppress(OSError, ValueError):  # no such file, or "max": no limit
            share, period = map(float, file.read_text().split())
            cores = min(cores, math.ceil(share / period))
    return max(1, cores)


def _networks(text: str) -> str:
    return ",".join(str(ipaddress.ip_network(part.strip())) for part in text.split(",") if part.strip())


Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False, description="a number of seconds, at least 0")]
Bytes = Annotated[int, Field(ge=0, description="a whole number of bytes, at least 0")]
Networks = Annotated[
    str, AfterValidator(_networks), Field(description="networks such as 10.0.0.0/8, separated by commas")
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Locations, concurrency and limits. Durations in seconds, sizes in bytes."""

    data: Path = Path("pliant-data")
    """Directory of all persistent data: the embedded queue's log, blobs, working files."""

    redis_url: str | None = Field(default=None, description="a URL")
    """`redis://`, `rediss://` or `unix://` URL; None: the embedded Valkey of `data`."""

    blob_url: str | None = Field(default=None, description="a URL")
    """`file:///…` or `s3://bucket/prefix`; None: the directory `blobs` inside `data`."""

    queue: str = Field(default="pliant", description="a name")
    """Name of the queue and prefix of every Redis key, so that two installations can share a server."""

    workers: int = Field(default=1, ge=1)
    """Number of jobs that run at once. `pliant up` and `pliant work` refuse more than fit, without a job, into the memory of the
    machine, its container or systemd unit; each takes 70 MiB."""

    threads: int | None = Field(default=None, ge=1)
    """Threads of one job, for the solver and for optical flow; None: the usable cores shared evenly among the workers."""

    time_limit: Seconds = 3600.0
    """Time limit of one attempt; 0: no limit."""

    memory_limit: Bytes = 0
    """Limit on a job's address space; 0: no limit. The libraries alone need half a gigabyte."""

    cancel_grace: Seconds = 10.0
    """Time for a job to stop by itself after a cancellation or its time limit, before it is killed."""

    stop_grace: Seconds = 10.0
    """Time for a running job to finish after SIGTERM, before it is requeued. Whatever stops the processes must wait 30 s longer:
    `TimeoutStopSec` of systemd, `stop_grace_period` of Compose."""

    lost_after: float = Field(default=10.0, ge=1, allow_inf_nan=False, description="a number of seconds, at least 1")
    """Time without heartbeats after which a running job is requeued."""

    max_attempts: int = Field(default=3, ge=1)
    """Maximum number of attempts at a job whose workers are lost."""

    webhook_networks: Networks = ""
    """Networks (CIDR, separated by commas) that webhooks may reach although their addresses are private, link-local, loopback or
    otherwise not public."""

    max_running: int = Field(default=0, ge=0)
    """Maximum number of running jobs per owner; further jobs wait. 0: no limit. Without tokens, all jobs have one owner."""

    retention: Seconds = 30 * 86400.0
    """Time for which a job that ends from now on is kept with its files; 0: indefinitely. Jobs that have ended keep their `expires_at`."""

    disk_quota: Bytes = 0
    """Maximum total bytes of jobs and uploads, above which new ones are rejected; 0: no quota. Space for the results of a job is reserved
    when it is accepted, by an estimate; results that turn out larger are stored beyond the quota."""

    read_memory: int = Field(default=8 << 30, ge=1 << 30, description="a whole number of bytes, at least 1 GiB")
    """Limit on the address space of the process that reads large inputs; inputs that need more are rejected as too_large."""

    film_memory: int = Field(default=4 << 30, ge=512 << 20, description="a whole number of bytes, at least 512 MiB")
    """Limit on the address space of the process that decodes and tracks a film; films that need more are rejected as too_large."""

    film_frames: int = Field(default=FilmLimits().frames, ge=3)
    """Maximum number of tracked frames per film."""

    film_pixels: int = Field(default=FilmLimits().pixels, ge=256)
    """Maximum width times height of a film, in pixels."""

    film_seconds: float = Field(
        default=FilmLimits().seconds, ge=1, allow_inf_nan=False, description="a number of seconds, at least 1"
    )
    """Maximum playing time of a film up to the last tracked frame."""

    upload_expiry: Seconds = 86400.0
    """Time for which an upload is kept after its last byte or its last use by a job; 0: indefinitely."""

    tracing: Literal["off", "otlp", "console"] = "off"
    """OpenTelemetry traces of requests and jobs; `otlp` sends them to `OTEL_EXPORTER_OTLP_ENDPOINT`. Needs the extra `otel`."""

    @classmethod
    def from_environment(cls) -> Settings:
        """Read the `PLIANT_…` variables, `.env` and the secret files: see `pliant.worker.environment.read`."""
        return read(cls)

    def to_environment(self) -> dict[str, str]:
        """Return the variables from which `from_environment` restores this record, for child processes."""
        values = {variable_of(field.name): getattr(self, field.name) for field in fields(self)}
        return {variable: str(value) for variable, value in values.items() if value is not None}

    @property
    def redis(self) -> str:
        """URL of Redis; by default the embedded server's."""
        return self.redis_url or f"unix://{quote(str(socket_path(self.data)))}"

    @property
    def blobs(self) -> str:
        """URL of the blob store; by default the directory `blobs` inside `data`."""
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
        """Directory of uploads."""
        return self.data.absolute() / "uploads"

    @property
    def threads_per_job(self) -> int:
        """Number of threads of one job."""
        return self.threads or max(1, usable_cores() // self.workers)

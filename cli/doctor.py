"""`pliant doctor` checks the installation, `pliant fsck` the consistency of the stored data."""

from __future__ import annotations

import platform
import re
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from pliant.cli.exits import Exit
from pliant.cli.extras import missing_modules, require_server
from pliant.cli.paths import installation, readable_installation
from pliant.cli.session import HOME, Json, Session, Url
from pliant.cli.show import out, print_json
from pliant.cli.up import Data, read_settings, unknown_variables

if TYPE_CHECKING:
    from pliant.worker.settings import Settings

OLDEST_PYTHON = (3, 11)
LITTLE_SPACE = 2 * 1024**3
"""Free bytes below which large jobs may not fit."""

EXTRAS = {"matplotlib": "result.plot()"}

Verdict = Literal["good", "note", "bad"]


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""
    """What to do; empty if nothing is wrong."""


def doctor(
    ctx: typer.Context,
    data: Data = None,
    port: Annotated[
        int | None,
        typer.Option(
            "--port", help="Port that `pliant up` would use.", min=1, max=65535, show_default="as `pliant up`"
        ),
    ] = None,
    url: Url = HOME,
    as_json: Json = False,
) -> None:
    """Check the installation; exit code 8 if something must be fixed."""
    findings = [
        *check_python(),
        *check_packages(),
        *check_films(),
        *check_blas(),
        *check_variables(),
        *check_cores(),
        *check_memory(),
        *check_storage(data or settings_here().data),
        *check_valkey(),
        *check_blobs(),
    ]
    report(
        [*findings, *check_port(port_here() if port is None else port), *check_service(ctx.obj, url)], as_json=as_json
    )


def fsck(data: Data = None, as_json: Json = False) -> None:
    """Compare job records, queue, files, uploads and scratch directories; exit code 8 if they are inconsistent.

    Needs a running queue: run it beside `pliant up`, or with PLIANT_REDIS_URL.
    """
    require_server("pliant fsck")
    settings = read_settings(data, None)
    installation(settings)
    readable_installation(settings)
    report(list(check_stored(settings)), as_json=as_json)


def settings_here() -> Settings:
    """Return the settings of this machine, or the defaults if the extra `server`, which reads them, is not installed."""
    from pliant.worker.settings import Settings

    return Settings() if missing_modules() else Settings.from_environment()


def port_here() -> int:
    """Return the port that `pliant up` would use on this machine."""
    from pliant.service.settings import ServiceSettings

    return ServiceSettings().port if missing_modules() else ServiceSettings.from_environment().port


def report(findings: list[Finding], *, as_json: bool) -> None:
    """Print the findings; raise `typer.Exit` if one of them is bad."""
    if as_json:
        print_json([asdict(finding) for finding in findings])
    else:
        show(findings)
    if any(finding.verdict == "bad" for finding in findings):
        raise typer.Exit(Exit.UNHEALTHY)


def check_python() -> Iterator[Finding]:
    """Check the interpreter."""
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    if sys.version_info < OLDEST_PYTHON:
        yield Finding("Python", "bad", found, "Install Python 3.11 or newer and recreate the environment.")
    else:
        yield Finding("Python", "good", found)


def needed(extra: str = "") -> list[str]:
    """Return the names of the packages that an extra needs, or that Pliant needs without any."""
    of_extra = re.compile(r'extra == "(.*)"')
    found = [(re.split(r"[^\w.-]", each, maxsplit=1)[0], of_extra.search(each)) for each in requires("pliant") or ()]
    return [name for name, needs in found if (needs[1] if needs else "") == extra]


def split_installed(names: list[str], version_of: Callable[[str], str]) -> tuple[str, str]:
    """Return the installed packages with their versions, and the others."""
    held, missing = [], []
    for name in names:
        try:
            held.append(f"{name} {version_of(name)}")
        except PackageNotFoundError:
            missing.append(name)
    return ", ".join(held), ", ".join(missing)


def check_packages(version_of: Callable[[str], str] = version) -> Iterator[Finding]:
    """Check the packages that Pliant needs or can use."""
    held, missing = split_installed(needed(), version_of)
    if missing:
        yield Finding(
            "packages",
            "bad",
            f"missing: {missing}",
            "Reinstall: pip install --force-reinstall . in Pliant's source folder",
        )
    else:
        yield Finding("packages", "good", held)
    absent = missing_modules()
    if absent:
        advice = "Only needed to run a service: pip install '.[server]' in Pliant's source folder"
        yield Finding("server", "note", f"missing: {', '.join(absent)}", advice)
    else:
        yield Finding("server", "good", split_installed(needed("server"), version_of)[0])
    for name, purpose in EXTRAS.items():
        try:
            yield Finding(name, "good", version_of(name))
        except PackageNotFoundError:
            yield Finding(name, "note", "not installed", f"Only {purpose} needs it: pip install {name}")


def check_films() -> Iterator[Finding]:
    """Check that OpenCV can be imported and decodes films."""
    try:
        from pliant.tracking.decoding.film import decoder
    except ImportError as fault:
        advice = "Only films need it: pip install '.[film]' in Pliant's source folder"
        yield Finding("films", "note", f"OpenCV cannot be imported: {fault}", advice)
        return
    found, has_ffmpeg = decoder()
    if has_ffmpeg:
        yield Finding("films", "good", found)
    else:
        advice = "It cannot decode films. Install the one from PyPI: pip install opencv-python-headless"
        yield Finding("films", "note", f"{found}, built without FFmpeg", advice)


def check_blas() -> Iterator[Finding]:
    """Time matrix products, which reveals a missing or oversubscribed BLAS, and count the active threads.

    The number of active threads is processor time divided by wall time, which is lower on a busy machine.
    """
    import os

    import numpy as np
    from pliant.worker.processes.containment import NUMERICAL_THREADS
    from pliant.worker.settings import usable_cores

    a = np.random.default_rng(0).normal(size=(1000, 1000))
    a @ a
    begin, used = time.perf_counter(), time.process_time()
    for _ in range(3):
        a @ a
    seconds = time.perf_counter() - begin
    threads, speed = (time.process_time() - used) / seconds, 3 * 2 * 1000**3 / seconds / 1e9
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"]
    limits = {name: os.environ[name] for name in NUMERICAL_THREADS if os.environ.get(name)}
    limited = ", ".join(f"{name}={value}" for name, value in limits.items()) or "no variable limits them"
    found = f"{blas}, {speed:.0f} Gflop/s, {threads:.1f} threads active ({limited})"
    if speed < 1:
        yield Finding("BLAS", "note", found, "This is slow. The machine is busy, or NumPy was built without a BLAS.")
    elif any(value.isdigit() and int(value) > usable_cores() for value in limits.values()):
        yield Finding(
            "BLAS", "note", found, f"More threads than the {usable_cores()} usable cores: lower the variable."
        )
    else:
        yield Finding("BLAS", "good", found)


def check_variables() -> Iterator[Finding]:
    """Check that every variable with our prefix is known."""
    if missing_modules():
        return
    for warning in unknown_variables():
        yield Finding("settings", "note", warning, "docs/reference/settings.md lists all settings.")


def check_cores() -> Iterator[Finding]:
    """Check how the cores are divided among workers."""
    from pliant.worker.settings import usable_cores

    settings = settings_here()
    threads, cores = settings.threads_per_job, usable_cores()
    found = f"{cores} usable cores; {settings.workers} worker(s) of {threads} thread(s)"
    if threads * settings.workers > cores:
        yield Finding("cores", "note", found, "More threads than cores: lower PLIANT_WORKERS or PLIANT_THREADS.")
    else:
        yield Finding("cores", "good", found)


def check_memory() -> Iterator[Finding]:
    """Check that the workers fit into the memory."""
    from pliant.worker.errors import InvalidSetting
    from pliant.worker.processes.memory import check_workers, memory_there

    settings = settings_here()
    try:
        check_workers(settings)
    except InvalidSetting as fault:
        yield Finding("memory", "bad", str(fault), "`pliant up` would not start: lower PLIANT_WORKERS.")
        return
    there = memory_there()
    if there > 0:
        yield Finding("memory", "good", f"{there / 1e9:.1f} GB for {settings.workers} worker(s)")


def check_storage(data: Path) -> Iterator[Finding]:
    """Check the data directory."""
    place = next(folder for folder in (data.absolute(), *data.absolute().parents) if folder.exists())
    try:
        probe = place / f".pliant-doctor-{time.time_ns()}"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as fault:
        yield Finding("storage", "bad", f"{data}: {fault.strerror}", "Use a writable directory: --data DIR")
        return
    free = shutil.disk_usage(place).free
    found = f"{data.absolute()}, {free / 1e9:.1f} GB free"
    if free < LITTLE_SPACE:
        yield Finding("storage", "note", found, "Large jobs may not fit: free some space or use another --data DIR.")
    else:
        yield Finding("storage", "good", found)


def check_valkey() -> Iterator[Finding]:
    """Check the queue: the Redis server of PLIANT_REDIS_URL, or the program of the embedded server."""
    if missing_modules():
        return
    from pliant.worker.errors import WorkerError
    from pliant.worker.processes.valkey import find_binary

    address = settings_here().redis_url
    if address is not None:
        yield _redis(address)
        return
    try:
        yield Finding("queue", "good", f"embedded Valkey, {find_binary()}")
    except WorkerError as fault:
        yield Finding("queue", "bad", str(fault), "Set PLIANT_REDIS_URL to a Redis or Valkey server.")


def check_port(port: int) -> Iterator[Finding]:
    """Check that the port is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as fault:
            yield Finding(
                "port",
                "note",
                f"{port}: {fault.strerror}",
                "A service may be running there already; otherwise choose another --port.",
            )
        else:
            yield Finding("port", "good", f"{port} is free")


def check_service(session: Session, url: str) -> Iterator[Finding]:
    """Check the service, if one is running."""
    from pliant.client.errors import PliantError

    try:
        with session.client(url, first_contact=0.5) as client:
            state = client.ready(timeout=3)
    except PliantError as fault:
        yield Finding(
            "service", "note", f"{url}: {fault}", "Start one with `pliant up`, or give its address with --url."
        )
        return
    yield Finding("service", "good", f"{url}: {', '.join(f'{name} {how}' for name, how in state.items())}")


def check_stored(settings: Settings) -> Iterator[Finding]:
    """Compare records, queue, blobs, scratch directories, uploads and incomplete request bodies with each other."""
    from pliant.service.spool import Incoming
    from pliant.worker.errors import JOB_STORE, StoreUnavailable
    from pliant.worker.jobs.service import Jobs
    from pliant.worker.maintenance.fsck import findings

    try:
        found = findings(Jobs.open(settings))
    except StoreUnavailable as fault:
        embedded = settings.redis_url is None and fault.what == JOB_STORE
        advice = (
            "Start `pliant up` on this directory, then check again."
            if embedded
            else "`pliant doctor` checks the stores."
        )
        yield Finding("stored", "bad", str(fault), advice)
        return
    for sentence in found:
        yield Finding(
            "stored", "bad", sentence, "Most mismatches are repaired within minutes; report those that remain."
        )
    abandoned = Incoming(settings.incoming).abandoned()
    for name in abandoned:
        advice = "The next start of the service removes it."
        yield Finding("stored", "bad", f"Folder incoming/{name} belongs to a process that has ended.", advice)
    if not found and not abandoned:
        yield Finding("stored", "good", "the stores are consistent with the job records")


def show(findings: list[Finding]) -> None:
    """Print the findings as a table."""
    from rich.table import Table
    from rich.text import Text

    signs = {"good": Text("✓", "green"), "note": Text("·", "yellow"), "bad": Text("✗", "red")}
    table = Table.grid(padding=(0, 1))
    for finding in findings:
        words = Text(finding.found, overflow="fold")  # never an ellipsis in place of the end of a path
        if finding.advice != "":
            words.append(f"\n→ {finding.advice}", "bold")
        table.add_row(signs[finding.verdict], Text(finding.what, "dim"), words)
    out().print(table)


def check_blobs() -> Iterator[Finding]:
    """Check the blob store of PLIANT_BLOB_URL by listing its contents, and by writing and removing a file."""
    url = settings_here().blob_url
    if url is None:
        return
    from pliant.worker.errors import InvalidSetting, StoreUnavailable
    from pliant.worker.store.blobs import Blobs

    try:
        blobs = Blobs.open(url)
        blobs.check()
        blobs.write(probe := f"doctor/{time.time_ns()}", b"")
        blobs.delete(probe)
    except InvalidSetting as fault:
        yield Finding("blobs", "bad", str(fault), "Correct the setting.")
    except StoreUnavailable as fault:
        advice = "Check the address, the bucket and the AWS_ variables; the store's own message is above."
        yield Finding("blobs", "bad", f"{url} cannot be used ({fault.reason})", advice)
    else:
        yield Finding("blobs", "good", f"{url} answers")


def _redis(address: str) -> Finding:
    """Check that the server accepts the credentials of the address, and that it does not evict keys."""
    advice = (
        "Check that the server runs, and address and password in PLIANT_REDIS_URL; unset it to use the embedded one."
    )
    from pliant.worker.errors import InvalidSetting, StoreForbidden, StoreUnavailable
    from pliant.worker.store.connection import check_server
    from pliant.worker.store.outage import address_of

    try:
        policy = check_server(address, queue=settings_here().queue)
    except InvalidSetting as fault:
        return Finding("queue", "bad", str(fault), "Correct the address.")
    except StoreUnavailable as fault:
        advice = fault.remedy if isinstance(fault, StoreForbidden) else advice
        return Finding("queue", "bad", f"{address_of(address)} cannot be used ({fault.reason})", advice)
    where = address_of(address)
    if policy not in ("noeviction", ""):
        remedy = "Set maxmemory-policy to noeviction: a server that evicts keys loses jobs."
        return Finding("queue", "bad", f"{where} has maxmemory-policy {policy}", remedy)
    return Finding("queue", "good", f"{where} answers")

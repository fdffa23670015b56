"""`pliant up` and `pliant work`: start the processes of an installation and keep them running."""

from __future__ import annotations

import http.client
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from pliant.cli.extras import require_server
from pliant.cli.paths import make_folder
from pliant.cli.session import Json
from pliant.cli.show import err, out, print_json, show_warnings

if TYPE_CHECKING:
    from pliant.worker.processes.supervisor import Child
    from pliant.worker.settings import Settings

READY_WITHIN = 120.0
"""Seconds within which every component must be ready; the first start also compiles Python bytecode."""

ANYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1", "": "127.0.0.1"}  # noqa: S104 - translated, not bound
"""The address to connect to when the service listens on every address."""

Data = Annotated[
    Path | None,
    typer.Option("--data", envvar="PLIANT_DATA", help="Directory for jobs and files.", show_default="pliant-data"),
]
Workers = Annotated[
    int | None, typer.Option("--workers", envvar="PLIANT_WORKERS", help="Jobs that run at the same time.", min=1, show_default="1")
]  # fmt: skip


Host = Annotated[
    str | None, typer.Option("--host", envvar="PLIANT_HOST", help="Address to listen on.", show_default="127.0.0.1")
]
Port = Annotated[
    int | None,
    typer.Option(
        "--port", envvar="PLIANT_PORT", help="Port to listen on; 0: a free one.", min=0, max=65535, show_default="8000"
    ),
]
Auth = Annotated[
    Literal["auto", "required", "off"] | None,
    typer.Option(
        "--auth",
        envvar="PLIANT_AUTH",
        help="Whether requests need a token; auto: not on the loopback address.",
        show_default="auto",
    ),
]


def up(
    host: Host = None,
    port: Port = None,
    data: Data = None,
    workers: Workers = None,
    auth: Auth = None,
    as_json: Json = False,
) -> None:
    """Run a complete installation: service, web page, queue and workers. Ctrl-C stops it.

    Without PLIANT_REDIS_URL it also runs a Valkey server, whose data is in the data directory.
    """
    require_server("pliant up")
    from pliant.service.settings import ServiceSettings
    from pliant.worker.processes.preflight import check_disks, check_settings, open_data_directory
    from pliant.worker.processes.supervisor import Supervisor, valkey_child, worker_children
    from pliant.worker.processes.valkey import Valkey

    settings, service = read_settings(data, workers), ServiceSettings.from_environment()
    show_warnings(unknown_variables())
    check_settings(settings)
    host = service.host if host is None else host
    port = free_port(host, service.port if port is None else port)
    url = address(host, port)
    make_folder(settings.data, "--data")
    open_data_directory(settings)
    check_disks(settings)
    with ExitStack() as held:
        children: list[Child] = []
        if settings.redis_url is None:
            valkey = Valkey.claim(settings.data)
            held.callback(valkey.release)
            children.append(valkey_child(valkey))
        children += [*worker_children(settings), service_child(settings, host, port, url, auth=auth or service.auth)]

        if await_store(settings, within=READY_WITHIN):
            Supervisor(children).run(on_started=lambda: _announce(url, settings, as_json=as_json))
    if not as_json:
        err().print("Stopped.")


def _announce(url: str, settings: Settings, *, as_json: bool) -> None:
    from rich.text import Text

    if as_json:
        print_json({"url": url, "data": str(settings.data.absolute()), "workers": settings.workers})
        sys.stdout.flush()
        return
    screen = out()
    screen.print(Text.assemble(("Pliant is ready", "bold green"), f"  {url}"))
    screen.print(
        Text(f"data in {settings.data.absolute()}, {settings.workers} worker(s); Ctrl-C stops everything", "dim")
    )


def work(data: Data = None, workers: Workers = None, as_json: Json = False) -> None:
    """Run only workers, for a service that uses the same PLIANT_REDIS_URL and PLIANT_BLOB_URL."""
    require_server("pliant work")
    from pliant.worker.processes.preflight import check_settings, open_data_directory
    from pliant.worker.processes.supervisor import Supervisor, worker_children

    settings = read_settings(data, workers)
    show_warnings(unknown_variables())
    check_settings(settings)
    make_folder(settings.data, "--data")
    open_data_directory(settings)

    def announce() -> None:
        if as_json:
            print_json({"workers": settings.workers, "queue": settings.queue})
            sys.stdout.flush()
            return
        err().print(f"{settings.workers} worker(s) of queue {settings.queue}; Ctrl-C stops them.")

    if await_store(settings):
        Supervisor(worker_children(settings)).run(on_started=announce)


def unknown_variables() -> list[str]:
    """Return a warning for each variable that looks like a setting and is none."""
    from pliant.service.settings import ServiceSettings
    from pliant.worker.environment import warnings_of_unknown
    from pliant.worker.settings import Settings as WorkerSettings

    return warnings_of_unknown(WorkerSettings, ServiceSettings)


def await_store(settings: Settings, *, within: float | None = None) -> bool:
    """Wait until the server of PLIANT_REDIS_URL answers; return False if Ctrl-C or SIGTERM ended that, as it may end the processes.

    Raises
    ------
    StoreUnavailable
        It does not answer `within` seconds.
    """
    from pliant.worker.processes.preflight import wait_for_store

    try:
        wait_for_store(settings, lambda message: err().print(message), within=within)
    except KeyboardInterrupt:
        return False
    return True


def read_settings(data: Path | None, workers: int | None) -> Settings:
    """Return the settings; the command line takes precedence over the environment."""
    from pliant.worker.settings import Settings as WorkerSettings

    settings = WorkerSettings.from_environment()
    if data is not None:
        settings = replace(settings, data=data)
    if workers is not None:
        settings = replace(settings, workers=workers)
    return settings


def free_port(host: str, port: int) -> int:
    """Return the port if it is free, or a free one for 0.

    Raises
    ------
    BadArgument
        The port is in use, or the address is not this machine's.
    """
    from pliant.client.errors import BadArgument

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as fault:
            raise BadArgument(
                f"Cannot listen on {host} port {port}: {fault}. Choose another port; --port 0 takes a free one."
            ) from fault
        chosen_port: int = probe.getsockname()[1]
        return chosen_port


def address(host: str, port: int) -> str:
    """Return the service's address on this machine."""
    name = ANYWHERE.get(host, host)
    return f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}"


def service_child(settings: Settings, host: str, port: int, url: str, *, auth: str) -> Child:
    """Return the API process as a child that counts as started once every component is ready."""
    from pliant.service.settings import ServiceSettings
    from pliant.worker.environment import given, unknown
    from pliant.worker.processes.supervisor import Child
    from pliant.worker.settings import Settings as WorkerSettings

    env = {**settings.to_environment(), "PLIANT_HOST": host, "PLIANT_PORT": str(port), "PLIANT_AUTH": auth}
    env |= dict.fromkeys(unknown(WorkerSettings, ServiceSettings), "")  # reported already; empty ones are not
    # Keep the access log out of this terminal, unless a log level was set.
    if "log_level" not in given(ServiceSettings):
        env["PLIANT_LOG_LEVEL"] = "warning"
    command = [sys.executable, "-m", "pliant.service"]
    return Child(name="service", argv=command, env=env, ready=until_ready(url), grace=15.0)


def until_ready(url: str) -> Callable[[subprocess.Popen[bytes]], None]:
    """Return a function that waits until every component of the service is ready.

    It does not use the SDK, whose libraries would stay in the memory of this process.

    Raises
    ------
    ServerFailed
        The process ended.
    Unreachable
        It was not ready in time.
    """

    def wait(process: subprocess.Popen[bytes]) -> None:
        from pliant.client.errors import Unreachable
        from pliant.worker.errors import ServerFailed

        reason = "it did not answer"
        deadline = time.monotonic() + READY_WITHIN
        while time.monotonic() < deadline:
            if process.poll() is not None:
                raise ServerFailed(f"The service ended with code {process.returncode}; the lines above state why.")
            try:
                reason = _why_not_ready(url)
            except (OSError, http.client.HTTPException, ValueError) as fault:
                reason = str(fault)
            if not reason:
                return
            time.sleep(0.1)
        raise Unreachable(f"The service is not ready after {READY_WITHIN:g} s: {reason}")

    return wait


def _why_not_ready(url: str) -> str:
    """Return the service's reason for not being ready, empty if it is."""
    asked = http.client.HTTPConnection(url.removeprefix("http://"), timeout=1)
    try:
        asked.request("GET", "/readyz")
        answer = asked.getresponse()
        body = answer.read()
    finally:
        asked.close()
    return "" if answer.status == HTTPStatus.OK else str(json.loads(body)["detail"])

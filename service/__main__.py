"""The API process: `python -m pliant.service`, configured by the environment."""

from __future__ import annotations

import json
import logging
import signal
import socket
import sys
from collections.abc import Callable, Sequence

import uvicorn
from fastapi import FastAPI
from pliant.service.app import create_app
from pliant.service.settings import ServiceSettings
from pliant.worker import tracing
from pliant.worker.environment import variable_of, warnings_of_unknown
from pliant.worker.errors import InvalidSetting, StoreForbidden, StoreUnavailable, WorkerError
from pliant.worker.jobs.service import Jobs
from pliant.worker.logs import configure_logging
from pliant.worker.processes.preflight import check_process, open_data_directory
from pliant.worker.records import utc_now
from pliant.worker.settings import Settings
from pliant.worker.store.outage import described
from pliant.worker.tokens import Tokens

_log = logging.getLogger("pliant.service")

KEEP_ALIVE = 75
"""Seconds that an idle connection is kept open: longer than proxies keep theirs (usually 60 s) and than clients pause between
requests, so that no request arrives on a connection that is just being closed."""

STOP_WITHIN = 10
"""Seconds that running requests have to finish after SIGTERM."""


class Server(uvicorn.Server):
    """A server that notifies the application when it stops, so that event streams can end.

    The notification runs on the event loop. A signal handler could run between a stream's check for shutdown and its wait; the
    stream would miss the notification and be cut off.
    """

    def __init__(self, config: uvicorn.Config, *, on_stop: Callable[[], None]) -> None:
        super().__init__(config)
        self._on_stop = on_stop

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """See uvicorn; called once, on shutdown."""
        self._on_stop()
        await super().shutdown(sockets)


def stop_streams(app: FastAPI) -> None:
    """End the event streams, if the application has started."""
    service = getattr(app.state, "service", None)
    if service is not None:
        service.followers.close()


def check_access(settings: ServiceSettings, tokens: Tokens) -> None:
    """Refuse to start if tokens are required and there is none, because nobody could use the service.

    If all have expired, it starts with a warning: share links still work, and a new token needs no restart.

    Raises
    ------
    InvalidSetting
        There is no token; the message names both remedies.
    StoreForbidden
        The store forbids reading the tokens.
    """
    if not settings.asks_for_tokens:
        if not settings.loopback:
            _log.warning(
                "PLIANT_AUTH=off on %s: anybody who reaches this address can read and delete every job", settings.host
            )
        return
    try:
        found = tokens.all()
    except StoreForbidden:
        raise
    except StoreUnavailable:
        return  # requests are answered 503 until the store is back
    if found and all(token.expired(utc_now()) for token in found):
        last = max(found, key=lambda token: token.expires_at or token.created_at)
        _log.warning(
            "every token has expired, the last one (%s, for %s) on %s: requests with them are refused. Create another with `pliant token "
            "create NAME --sharing %s`, with the same PLIANT_DATA or PLIANT_REDIS_URL; it is valid at once.",
            last.id, last.name, f"{last.expires_at:%Y-%m-%d %H:%M} UTC", last.id,
        )  # fmt: skip
    if not found:
        raise InvalidSetting(
            variable_of("auth"),
            expected=f"a token for requests to {settings.host}",
            got="none",
            hint="Create one with `pliant token create NAME`, with the same PLIANT_DATA or PLIANT_REDIS_URL, then start again; "
            "or set PLIANT_AUTH=off if a proxy controls access.",
        )


def check_store(jobs: Jobs) -> None:
    """Check the version of the records, if the store answers; if not, requests are answered 503 until it does.

    Raises
    ------
    NewerData
        The records were written by a newer version.
    StoreForbidden
        The store forbids a command.
    """
    try:
        jobs.records.ping()
    except StoreForbidden:
        raise
    except StoreUnavailable:
        return


def print_openapi(*, schemas_only: bool) -> None:
    """Write the OpenAPI document of a service with default settings to standard output, or its schemas alone."""
    of_worker = Settings()
    app = create_app(Jobs.open(of_worker), ServiceSettings(), tokens=Tokens.open(of_worker))
    document = {**app.openapi(), "paths": {}} if schemas_only else app.openapi()
    sys.stdout.write(json.dumps(document, indent=2, ensure_ascii=False) + "\n")


def main(arguments: Sequence[str] = ()) -> int:
    """Serve until SIGTERM or SIGINT; return the exit code. With `openapi [--schemas]` print the OpenAPI document instead."""
    if arguments[:1] == ["openapi"]:
        print_openapi(schemas_only="--schemas" in arguments)
        return 0
    try:
        settings = ServiceSettings.from_environment()
        configure_logging(settings.log_level, settings.log_format)
        of_worker = Settings.from_environment()
        for warning in warnings_of_unknown(Settings, ServiceSettings):
            _log.warning("%s", warning)
        tokens = Tokens.open(of_worker)
        check_access(settings, tokens)
        open_data_directory(of_worker)
        check_process(of_worker)
        tracing.configure(of_worker.tracing, service="pliant-api")
        jobs = Jobs.open(of_worker)
        check_store(jobs)
        app = create_app(jobs, settings, tokens=tokens)
    except StoreForbidden as error:
        sys.stderr.write(f"{described(error, of_worker.redis)}\n")
        return 2
    except WorkerError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
        timeout_keep_alive=KEEP_ALIVE,
        timeout_graceful_shutdown=STOP_WITHIN,
    )
    server = Server(config, on_stop=lambda: stop_streams(app))
    # uvicorn raises the signals again after it has stopped, which would end this process by a signal.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: setattr(server, "should_exit", True))
    server.run()
    tracing.finish()
    return 0 if server.started else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

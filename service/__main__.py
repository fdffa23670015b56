"""The process of the service: `python -m pliant.service`, set up by the environment alone."""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI
from pliant.service.app import create_app
from pliant.service.settings import InvalidServiceSetting, ServiceSettings
from pliant.worker.errors import InvalidSetting, StoreUnavailable
from pliant.worker.jobs.service import Jobs
from pliant.worker.settings import Settings
from pliant.worker.tokens import Tokens

_log = logging.getLogger("pliant.service")

KEEP_ALIVE = 75
"""Seconds that an idle connection is kept: longer than a proxy keeps its own (60 s as a rule) and than clients pause between two looks,
or now and then a request would meet a connection that is just being closed."""

STOP_WITHIN = 10
"""Seconds that running requests get after SIGTERM."""


class Server(uvicorn.Server):
    """A server that tells the application when it stops, so that streams without end can end.

    It tells it on the event loop. From within the signal's handler, which runs between any two steps of a stream, a stream
    could be told after it had looked whether the end has come and before it waited: it would wait on, and be cut off.
    """

    def __init__(self, config: uvicorn.Config, *, on_stop: Callable[[], None]) -> None:
        super().__init__(config)
        self._on_stop = on_stop

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """See uvicorn; called once, when it was asked to stop."""
        self._on_stop()
        await super().shutdown(sockets)


def stop_streams(app: FastAPI) -> None:
    """End the event streams, if the application has started at all."""
    service = getattr(app.state, "service", None)
    if service is not None:
        service.followers.close()


def check_door(settings: ServiceSettings, tokens: Tokens) -> None:
    """Refuse to start where tokens are asked for and there are none: nobody could use the service, and why would be a riddle.

    Raises
    ------
    InvalidServiceSetting
        With the two ways out.
    """
    if not settings.asks_for_tokens:
        if not settings.loopback:
            _log.warning(
                "PLIANT_AUTH=off on %s: whoever reaches this address may read and delete every job", settings.host
            )
        return
    try:
        usable = tokens.usable()
    except StoreUnavailable:
        return  # then every request is answered 503 until it is there
    if not usable:
        raise InvalidServiceSetting(
            f"Requests to {settings.host} need a token, and there is none that is valid. Make one with `pliant token create NAME`, "
            "with the same PLIANT_DATA or PLIANT_REDIS_URL, then start again; or say PLIANT_AUTH=off if something else keeps "
            "strangers away."
        )


def main() -> int:
    """Serve until SIGTERM or SIGINT; return the exit code."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    for name in ("uvicorn", "uvicorn.error"):  # its start and stop are said by whoever started us
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        settings = ServiceSettings.from_environment(os.environ)
        of_worker = Settings.from_environment(os.environ)
        tokens = Tokens.open(of_worker)
        check_door(settings, tokens)
    except (InvalidServiceSetting, InvalidSetting) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    app = create_app(Jobs.open(of_worker), settings, tokens=tokens)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE,
        timeout_graceful_shutdown=STOP_WITHIN,
    )
    server = Server(config, on_stop=lambda: stop_streams(app))
    for number in (
        signal.SIGTERM,
        signal.SIGINT,
    ):  # uvicorn raises them again when it has stopped, which would be our end by signal
        signal.signal(number, lambda *_: setattr(server, "should_exit", True))
    server.run()
    return 0 if server.started else 1


if __name__ == "__main__":
    sys.exit(main())

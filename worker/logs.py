"""Logging of one process: level, console or JSON format, and the request id in every line."""

from __future__ import annotations

import logging
from contextvars import ContextVar
from typing import Literal

from pydantic.dataclasses import dataclass

LogLevel = Literal["debug", "info", "warning", "error"]
LogFormat = Literal["console", "json"]

REQUEST_ID: ContextVar[str] = ContextVar("pliant_request_id", default="-")
"""Id of the request that the current task or thread handles."""

_NOISY = {
    "rq.worker": logging.WARNING,
    "uvicorn": logging.WARNING,
    "uvicorn.error": logging.WARNING,
    "httpx": logging.WARNING,
}
"""Minimum levels of verbose library loggers; `pliant up` itself reports start and stop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogSettings:
    """Log settings of a worker or reconciler; the service's own settings include the same variables."""

    log_level: LogLevel = "info"
    log_format: LogFormat = "console"


class AddRequestId(logging.Filter):
    """Adds `request_id` to every record."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Add the request id; never drop the record."""
        record.request_id = REQUEST_ID.get()
        return True


def configure_logging(level: LogLevel, format: LogFormat) -> None:
    """Send this process's log records of at least `level` to standard error."""
    handler = logging.StreamHandler()
    handler.addFilter(AddRequestId())
    handler.setFormatter(formatter(format))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    for name, least in _NOISY.items():
        logging.getLogger(name).setLevel(least)


def formatter(format: LogFormat) -> logging.Formatter:
    """Return the formatter; JSON lines include every extra field of a record, and times as RFC 3339 in UTC."""
    if format == "console":
        return logging.Formatter("%(asctime)s %(levelname)s %(name)s [%(request_id)s]: %(message)s")
    from pythonjsonlogger.json import (
        JsonFormatter,  # here, because the settings are read without the extra `server`, too
    )

    return JsonFormatter(
        ["levelname", "name", "message", "request_id"],
        timestamp="time",
        rename_fields={"levelname": "level", "name": "logger"},
    )

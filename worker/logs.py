"""Logging of the process: a level, lines for people or JSON, and the id of the request behind every line."""

from __future__ import annotations

import logging
from contextvars import ContextVar
from typing import Literal

from pydantic.dataclasses import dataclass
from pythonjsonlogger.json import JsonFormatter

LogLevel = Literal["debug", "info", "warning", "error"]
LogFormat = Literal["console", "json"]

REQUEST_ID: ContextVar[str] = ContextVar("pliant_request_id", default="-")
"""The request that the current task or thread works for."""

_NOISY = {
    "rq.worker": logging.WARNING,
    "uvicorn": logging.WARNING,
    "uvicorn.error": logging.WARNING,
    "httpx": logging.WARNING,
}
"""Loggers of libraries, and the least level that is of use: `pliant up` reports start and stop itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogSettings:
    """How a worker or a reconciler logs; the API has the same variables among its own."""

    log_level: LogLevel = "info"
    log_format: LogFormat = "console"


class AddRequestId(logging.Filter):
    """Adds `request_id` to every record."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Add it, and keep the record."""
        record.request_id = REQUEST_ID.get()
        return True


def configure_logging(level: LogLevel, format: LogFormat) -> None:
    """Send all records of this process from a level on to standard error."""
    handler = logging.StreamHandler()
    handler.addFilter(AddRequestId())
    handler.setFormatter(formatter(format))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    for name, least in _NOISY.items():
        logging.getLogger(name).setLevel(least)


def formatter(format: LogFormat) -> logging.Formatter:
    """Return the formatter; JSON lines carry every extra field of a record, times are RFC 3339 in UTC."""
    if format == "console":
        return logging.Formatter("%(asctime)s %(levelname)s %(name)s [%(request_id)s]: %(message)s")
    return JsonFormatter(
        ["levelname", "name", "message", "request_id"],
        timestamp="time",
        rename_fields={"levelname": "level", "name": "logger"},
    )

"""OpenTelemetry traces of a job, from its request through the queue into the stages of the solver. Off by default.

The request's span context is stored in the job's record as a W3C `traceparent`, so that an attempt in another process, perhaps on
another host, continues the same trace. OpenTelemetry is imported only if tracing is on.
"""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import Any

from pliant.worker.errors import InvalidSetting

logger = logging.getLogger(__name__)

MODULES = {
    "off": (),
    "console": ("opentelemetry.sdk.trace.export",),
    "otlp": ("opentelemetry.sdk.trace.export", "opentelemetry.exporter.otlp.proto.http.trace_exporter"),
}
"""The modules of OpenTelemetry that each kind of tracing needs."""

_provider: Any = None
"""The process's `TracerProvider`; None: tracing is off."""


def configure(kind: str, *, service: str) -> None:
    """Configure tracing of this process under the name `service`. Call it after a fork, because exporters have threads.

    `kind` is `off`; `otlp`, which sends to `OTEL_EXPORTER_OTLP_ENDPOINT` and reads the other `OTEL_…` variables; or `console`.

    Raises
    ------
    InvalidSetting
        The extra `otel` is not installed.
    """
    check(kind)
    if kind == "off":
        use(None)
        return
    from opentelemetry.sdk.resources import SERVICE_NAME, Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

    provider = TracerProvider(resource=Resource.create({SERVICE_NAME: service}))
    provider.add_span_processor(BatchSpanProcessor(_exporter(kind)))
    use(provider)


def check(kind: str) -> None:
    """Check that tracing can be configured, without configuring it: a worker must know before it takes jobs.

    Raises
    ------
    InvalidSetting
        The extra `otel` is not installed.
    """
    try:
        for module in MODULES[kind]:
            importlib.import_module(module)
    except ImportError as error:
        expected = "off, or the extra otel (pip install '.[otel]' in Pliant's source folder)"
        raise InvalidSetting("PLIANT_TRACING", expected=expected, got=kind) from error


def use(provider: Any) -> None:
    """Create spans with this `TracerProvider`; None turns tracing off."""
    global _provider
    _provider = provider


def finish() -> None:
    """Send the remaining spans and turn tracing off, before the process ends."""
    if _provider is not None:
        _provider.shutdown()
        use(None)


@contextmanager
def span(name: str, *, parent: str | None = None, **attributes: str | int | float) -> Iterator[Any]:
    """Time a block as a span; yield None if tracing is off.

    `parent` is a `traceparent` to continue; None: the current span of this thread or task. Attribute names get the prefix `pliant.`.
    """
    if _provider is None:
        yield None
        return
    named = {f"pliant.{key}": value for key, value in attributes.items()}
    tracer = _provider.get_tracer("pliant")
    with tracer.start_as_current_span(name, context=_context(parent), attributes=named) as current:
        yield current


def past(name: str, *, begin: datetime, end: datetime) -> None:
    """Add a span for an interval that has ended, such as the wait in the queue."""
    if _provider is not None:
        tracer = _provider.get_tracer("pliant")
        tracer.start_span(name, start_time=_nanoseconds(begin)).end(end_time=_nanoseconds(end))


def traceparent() -> str | None:
    """Return the current span as a W3C `traceparent`, None if there is none."""
    if _provider is None:
        return None
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    carrier: dict[str, str] = {}
    TraceContextTextMapPropagator().inject(carrier)
    return carrier.get("traceparent")


class Stages:
    """A span for each stage of a job, one after the other."""

    def __init__(self) -> None:
        self._name: str | None = None
        self._span: Any = None

    def enter(self, name: str) -> None:
        """End the current stage and begin another; do nothing if it is the same."""
        if _provider is not None and name != self._name:
            self.end()
            self._name, self._span = name, _provider.get_tracer("pliant").start_span(name)

    def end(self) -> None:
        """End the current stage, if any."""
        if self._span is not None:
            self._span.end()
            self._name = self._span = None


def _exporter(kind: str) -> Any:
    if kind == "console":
        from opentelemetry.sdk.trace.export import ConsoleSpanExporter

        return ConsoleSpanExporter(out=os.fdopen(os.dup(1), "w"))  # a job's own output is redirected while it solves
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

    return OTLPSpanExporter()


def _context(parent: str | None) -> Any:
    if parent is None:
        return None
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    return TraceContextTextMapPropagator().extract({"traceparent": parent})


def _nanoseconds(moment: datetime) -> int:
    return int(moment.timestamp() * 1e9)

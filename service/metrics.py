"""Metrics for Prometheus: requests of this process, and the state of jobs, queue and workers read from the store on each scrape."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime

import prometheus_client
from pliant.schemas.job import Status
from pliant.worker.errors import StoreUnavailable
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import RUN_SECONDS
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4 as MEDIA_TYPE
from prometheus_client.registry import Collector, CollectorRegistry
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["MEDIA_TYPE", "CountRequests", "Metrics"]

ANSWER_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper bounds of the histogram of the time until a response begins, in seconds."""

FAILURES = ("internal_error", "out_of_memory", "storage_failed", "timed_out", "worker_lost")
"""Error codes that alerts count. Counters of known labels start at 0, because a rate ignores a counter's first value."""

WEBHOOKS = ("delivered", "given_up", "tried")

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class Metrics:
    """The collectors of one application, in their own registry."""

    def __init__(self) -> None:
        prometheus_client.disable_created_metrics()  # type: ignore[no-untyped-call]
        self.registry = CollectorRegistry()
        self.answers = prometheus_client.Counter(
            "pliant_http_requests_total",
            "Answers of this process, by method, route and status.",
            ["method", "route", "status"],
            registry=self.registry,
        )
        self.seconds = prometheus_client.Histogram(
            "pliant_http_request_duration_seconds",
            "Seconds until an answer begins, by method and route, without answers that waited for a job.",
            ["method", "route"],
            buckets=ANSWER_SECONDS,
            registry=self.registry,
        )
        self.active = prometheus_client.Gauge(
            "pliant_http_requests_in_progress", "Requests in progress, event streams included.", registry=self.registry
        )

    def count(self, method: str, route: str, *, status: int, seconds: float | None) -> None:
        """Count a response; `seconds` is None if the client asked it to wait."""
        method = method if method in METHODS else "other"
        self.answers.labels(method, route, str(status)).inc()
        if seconds is not None:
            self.seconds.labels(method, route).observe(seconds)

    def exposition(self, jobs: Jobs) -> bytes:
        """Return all metrics, for the jobs of all owners, in Prometheus' text format. Blocks; call it on a thread."""
        of_store = CollectorRegistry()
        of_store.register(StoreCollector(jobs))
        return prometheus_client.generate_latest(of_store) + prometheus_client.generate_latest(self.registry)


class StoreCollector(Collector):
    """Collects the state of an installation from its store; without an answer of the store, only `pliant_store_up` 0."""

    def __init__(self, jobs: Jobs) -> None:
        self._jobs = jobs

    def describe(self) -> Iterable[Metric]:
        """Return nothing, because registering must not read the store."""
        return []

    def collect(self) -> Iterable[Metric]:
        """Return the metrics."""
        try:
            found, up = list(self._state()), 1.0
        except StoreUnavailable:
            found, up = [], 0.0
        return [GaugeMetricFamily("pliant_store_up", "1 if the job store answers.", value=up), *found]

    def _state(self) -> Iterable[Metric]:
        records, queue = self._jobs.records, self._jobs.queue
        tallies = records.tallies()
        by_status = GaugeMetricFamily("pliant_jobs", "Jobs that are kept, by status.", labels=["status"])
        for status in Status:
            by_status.add_metric([status.value], records.count([status]))
        yield by_status
        oldest = records.oldest(Status.QUEUED)
        age = 0.0 if oldest is None else max(0.0, (datetime.now(UTC) - oldest).total_seconds())
        for name, text, value in (
            ("pliant_queue_depth", "Jobs in the queue, next to be taken by a worker.", len(queue.waiting())),
            ("pliant_queue_oldest_seconds", "Seconds since the oldest queued job was created.", age),
            ("pliant_workers_alive", "Workers with a recent heartbeat.", len(queue.workers())),
            ("pliant_stored_bytes", "Bytes of all jobs' inputs and results, with those reserved.", records.used()),
        ):
            yield GaugeMetricFamily(name, text, value=value)
        final = [each.value for each in Status if each.final]
        text = "Jobs that ended, by status."
        yield _counter(tallies, "pliant_jobs_ended_total", text, group="ended", label="status", known=final)
        text = "Failed jobs, by error code."
        yield _counter(tallies, "pliant_jobs_failed_total", text, group="failed", label="code", known=FAILURES)
        yield _durations(tallies)
        text = "Webhooks: attempts, and their outcomes."
        yield _counter(tallies, "pliant_webhooks_total", text, group="webhooks", label="result", known=WEBHOOKS)


def _counter(
    tallies: Mapping[str, float], name: str, text: str, *, group: str, label: str, known: Iterable[str]
) -> Metric:
    family = CounterMetricFamily(name, text, labels=[label])
    for value_of_label, value in sorted({**dict.fromkeys(known, 0.0), **_group(tallies, group)}.items()):
        family.add_metric([value_of_label], value)
    return family


def _durations(tallies: Mapping[str, float]) -> Metric:
    """Return the histogram of run times. The store counts per bucket; in Prometheus each bucket includes all lower ones."""
    text = "Run time of jobs' last attempts, by final status."
    family = HistogramMetricFamily("pliant_job_run_seconds", text, labels=["status"])
    for status in (each.value for each in Status if each.final):
        held = _group(tallies, f"ran:{status}")
        total, buckets = 0.0, []
        for bound in (*(f"{each:g}" for each in RUN_SECONDS), "+Inf"):
            total += held.get(bound, 0.0)
            buckets.append((bound, total))
        family.add_metric([status], buckets, sum_value=held.get("sum", 0.0))
    return family


def _group(tallies: Mapping[str, float], group: str) -> dict[str, float]:
    """Return the tallies of a group, without the group's prefix in their names."""
    return {name.removeprefix(f"{group}:"): value for name, value in tallies.items() if name.startswith(f"{group}:")}


class CountRequests:
    """ASGI middleware that counts every response by the route's pattern rather than by the path, which clients choose."""

    def __init__(self, app: ASGIApp, metrics: Metrics, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._app = app
        self._metrics = metrics
        self._clock = clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and count its response when it begins."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun, counted = self._clock(), False

        def count(status: int, *, waited: bool) -> None:
            nonlocal counted
            if not counted:
                counted = True
                seconds = None if waited else self._clock() - begun
                self._metrics.count(scope["method"], _route(scope), status=status, seconds=seconds)

        async def watched(message: Message) -> None:
            if message["type"] == "http.response.start":
                count(message["status"], waited=any(name == b"preference-applied" for name, _ in message["headers"]))
            await send(message)

        with self._metrics.active.track_inprogress():
            try:
                await self._app(scope, receive, watched)
            except Exception:
                # The response to an unexpected exception is created outside of this middleware.
                count(500, waited=False)
                raise


def _route(scope: Scope) -> str:
    """Return the pattern of the route that handled the request, or `other` without one."""
    return str(getattr(scope.get("route"), "path", None) or "other")

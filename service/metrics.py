"""Numbers for Prometheus: how many requests this process answered, and how jobs, queue and workers stand.

Written by hand, 0.0.4 of the text format: the usual library keeps its numbers in a process, and ours lie in the store, where the
workers count them. What is counted here are the requests alone.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime

from pliant.schemas.job import Status
from pliant.worker.errors import StoreUnavailable
from pliant.worker.jobs.service import Jobs
from pliant.worker.records import RUN_SECONDS
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
ANSWER_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Upper bounds of the histogram of the time until an answer begins, in seconds."""

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})

Sample = tuple[str, Mapping[str, str], float]
"""What stands behind the family's name, labels, value."""


class Requests:
    """What is counted of the requests of one process. Used from the event loop alone."""

    def __init__(self) -> None:
        self.answers: Counter[tuple[str, str, str]] = Counter()
        """By method, route and status."""
        self.seconds: dict[str, Histogram] = {}
        """Until the answer begins, by route."""
        self.under_way = 0

    def count(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count an answer."""
        self.answers[method if method in METHODS else "other", route, str(status)] += 1
        self.seconds.setdefault(route, Histogram(ANSWER_SECONDS)).add(seconds)


class Histogram:
    """How many values there were up to each bound, and their sum."""

    def __init__(self, bounds: tuple[float, ...]) -> None:
        self._bounds = bounds
        self.held: Counter[str] = Counter()
        self.sum = 0.0

    def add(self, value: float) -> None:
        """Count a value."""
        self.held[next((f"{bound:g}" for bound in self._bounds if value <= bound), "+Inf")] += 1
        self.sum += value

    def samples(self, **labels: str) -> Iterable[Sample]:
        """Return the lines, each bound with all that lie below it."""
        total = 0.0
        for bound in (*(f"{each:g}" for each in self._bounds), "+Inf"):
            total += self.held[bound]
            yield "_bucket", {**labels, "le": bound}, total
        yield "_sum", labels, self.sum
        yield "_count", labels, total


class Counting:
    """ASGI middleware, the outermost: counts every answer by the route's pattern, never by the address, which strangers choose."""

    def __init__(self, app: ASGIApp, requests: Requests, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._app = app
        self._requests = requests
        self._clock = clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and watch its answer begin."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun, counted = self._clock(), False

        async def watched(message: Message) -> None:
            nonlocal counted
            if message["type"] == "http.response.start" and not counted:
                counted = True
                self._requests.count(scope["method"], _route(scope), message["status"], self._clock() - begun)
            await send(message)

        self._requests.under_way += 1
        try:
            await self._app(scope, receive, watched)
        except Exception:
            if not counted:  # a defect; its answer is made outside of us
                self._requests.count(scope["method"], _route(scope), 500, self._clock() - begun)
            raise
        finally:
            self._requests.under_way -= 1


def _route(scope: Scope) -> str:
    """Return the pattern of the route that answers, `other` where none does."""
    return str(getattr(scope.get("route"), "path", None) or "other")


def exposition(jobs: Jobs, requests: Requests) -> str:
    """Return everything there is to tell. A store that is away is told, too. Blocks; call it on a thread.

    Parameters
    ----------
    jobs : Jobs
        Everybody's.
    requests : Requests
        What this process has counted.
    """
    try:
        standing = list(_standing(jobs))
        up = 1.0
    except StoreUnavailable:
        standing, up = [], 0.0
    return "".join(
        [
            _family("pliant_store_up", "gauge", "1 if the job store answers.", [("", {}, up)]),
            *standing,
            *_answered(requests),
        ]
    )


def _standing(jobs: Jobs) -> Iterable[str]:
    records, tallies = jobs.records, jobs.records.tallies()
    oldest = records.oldest(Status.QUEUED)
    age = 0.0 if oldest is None else max(0.0, (datetime.now(UTC) - oldest).total_seconds())
    counts = [("", {"status": status.value}, float(records.count([status]))) for status in Status]
    yield _family("pliant_jobs", "gauge", "Jobs that are kept, by status.", counts)
    depth = float(len(jobs.queue.waiting()))
    yield _family("pliant_queue_depth", "gauge", "Jobs in the queue, next to be taken by a worker.", [("", {}, depth)])
    said = "Seconds since the oldest waiting job was made."
    yield _family("pliant_queue_oldest_seconds", "gauge", said, [("", {}, age)])
    alive = float(len(jobs.queue.workers()))
    yield _family("pliant_workers_alive", "gauge", "Workers that gave a sign of life lately.", [("", {}, alive)])
    used = float(records.used())
    yield _family("pliant_stored_bytes", "gauge", "Bytes of all jobs' inputs and results.", [("", {}, used)])
    ended = [("", {"status": name}, value) for name, value in _under(tallies, "ended")]
    yield _family("pliant_jobs_ended_total", "counter", "Jobs that ended, by status.", ended)
    failed = [("", {"code": name}, value) for name, value in _under(tallies, "failed")]
    yield _family("pliant_jobs_failed_total", "counter", "Jobs that failed, by the code of the reason.", failed)
    yield _family(
        "pliant_job_run_seconds", "histogram", "How long jobs ran, last attempt, by how they ended.", _ran(tallies)
    )
    hooks = [("", {"result": name}, value) for name, value in _under(tallies, "webhooks")]
    yield _family("pliant_webhooks_total", "counter", "Webhooks: tries, and how they ended.", hooks)


def _ran(tallies: Mapping[str, float]) -> list[Sample]:
    lines: list[Sample] = []
    for status in (each.value for each in Status if each.final):
        histogram = Histogram(RUN_SECONDS)
        for name, value in _under(tallies, f"ran:{status}"):
            if name == "sum":
                histogram.sum = value
            else:
                histogram.held[name] = int(value)
        if histogram.held:
            lines += histogram.samples(status=status)
    return lines


def _answered(requests: Requests) -> Iterable[str]:
    answers = [
        ("", {"method": method, "route": route, "status": status}, float(count))
        for (method, route, status), count in sorted(requests.answers.items())
    ]
    yield _family(
        "pliant_http_requests_total", "counter", "Answers of this process, by method, route and status.", answers
    )
    times = [line for route, held in sorted(requests.seconds.items()) for line in held.samples(route=route)]
    yield _family("pliant_http_answer_seconds", "histogram", "Seconds until an answer begins, by route.", times)
    under_way: list[Sample] = [("", {}, float(requests.under_way))]
    yield _family(
        "pliant_http_under_way", "gauge", "Requests that are being answered now, streams among them.", under_way
    )


def _under(tallies: Mapping[str, float], group: str) -> list[tuple[str, float]]:
    return sorted(
        (name.removeprefix(f"{group}:"), value) for name, value in tallies.items() if name.startswith(f"{group}:")
    )


def _family(name: str, kind: str, said: str, samples: Iterable[Sample]) -> str:
    lines = [f"# HELP {name} {said}", f"# TYPE {name} {kind}"]
    for suffix, labels, value in samples:
        held = ",".join(f'{key}="{_escaped(text)}"' for key, text in labels.items())
        lines.append(f"{name}{suffix}{{{held}}} {value:.15g}" if held else f"{name}{suffix} {value:.15g}")
    return "\n".join(lines) + "\n"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")

"""Draw the trace of one job over API, queue, worker and solver, and print its log lines: `python -m benchmarks.figures.trace`.

API and worker are separate processes, which print their spans and log lines. The picture is written to docs/images/trace.svg.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from xml.sax.saxutils import escape

import httpx
from pliant.client import Client
from pliant.solver.gallery import face
from pliant.worker.processes.containment import die_with_parent
from pliant.worker.processes.valkey import attended
from pliant.worker.settings import Settings

IMAGE = Path(__file__).parents[2] / "docs" / "images" / "trace.svg"
WIDTH, LEFT, ROW = 860, 190, 26
"""Layout of the picture, in pixels."""

INTERRUPTIONS = (signal.SIGINT, signal.SIGTERM)

COLOURS = {"API": "#3b6fb6", "queue": "#b0b7c3", "worker": "#2f8f6b", "solver": "#d08a2e"}


@dataclass(frozen=True)
class Span:
    """One bar of the picture; times in seconds since 1970."""

    name: str
    service: str
    begin: float
    end: float

    @property
    def place(self) -> str:
        """Component that spent the time: API, queue, worker or solver."""
        if self.service == "pliant-api":
            return "API"
        worker = {"queued": "queue", "attempt": "worker", "loading": "worker", "exporting": "worker"}
        return worker.get(self.name, "solver")


@contextmanager
def installation(folder: Path) -> Iterator[str]:
    """Run Valkey, an API process and a worker; yield the address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings = Settings(data=folder / "data", threads=1, tracing="console")
    env = {
        **os.environ, **settings.to_environment(), "PLIANT_PORT": str(port), "PLIANT_LOG_FORMAT": "json",
        "PLIANT_LOG_LEVEL": "info",
    }  # fmt: skip
    url = f"http://127.0.0.1:{port}"
    with attended(settings), ExitStack() as started:
        for name, module in (("api", ["pliant.service"]), ("worker", ["pliant.worker", "work"])):
            with (folder / f"{name}.spans").open("wb") as out, (folder / f"{name}.log").open("wb") as log, _held():
                process = subprocess.Popen(
                    [sys.executable, "-m", *module], env=env, stdout=out, stderr=log,
                    # An interruption may come before the next line.
                    preexec_fn=partial(_begin, os.getpid()),
                )  # fmt: skip
            started.enter_context(process)  # waits for its end
            started.callback(process.terminate)
        until = time.monotonic() + 60
        while time.monotonic() < until:
            try:
                if httpx.get(f"{url}/readyz").status_code == 200:
                    break
            except httpx.TransportError:
                pass
            time.sleep(0.2)
        yield url


@contextmanager
def _held() -> Iterator[None]:
    """Hold interruptions back: Python ignores exceptions that are raised in what the logging module does after a fork."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPTIONS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(parent: int) -> None:
    """End with the parent, and receive interruptions again."""
    die_with_parent(parent, how=signal.SIGTERM)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPTIONS)


def read_spans(text: str) -> list[tuple[str, Span]]:
    """Return the spans that a console exporter printed, each with its trace's id."""
    found, decoder, place = [], json.JSONDecoder(), 0
    while (place := text.find("{", place)) >= 0:
        raw, place = decoder.raw_decode(text, place)
        begin, end = (datetime.fromisoformat(raw[key]).timestamp() for key in ("start_time", "end_time"))
        service = raw["resource"]["attributes"]["service.name"]
        found.append((raw["context"]["trace_id"], Span(raw["name"], service, begin, end)))
    return found


def draw(spans: list[Span]) -> str:
    """Return an SVG picture of a trace: a bar with its duration for each span."""
    spans = sorted(spans, key=lambda each: (each.begin, -each.end))
    first, last = min(each.begin for each in spans), max(each.end for each in spans)
    scale = (WIDTH - LEFT - 90) / (last - first)
    height = ROW * (len(spans) + 2) + 10
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif" font-size="13">',
        "<title>Trace of one job</title>",
        f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>',
    ]
    for index, (place, colour) in enumerate(COLOURS.items()):
        x = LEFT + 110 * index
        lines.append(f'<rect x="{x}" y="8" width="12" height="12" fill="{colour}"/>')
        lines.append(f'<text x="{x + 18}" y="19" fill="#222">{place}</text>')
    for index, span in enumerate(spans, 1):
        x, y = LEFT + (span.begin - first) * scale, index * ROW + 8
        width = max(1.5, (span.end - span.begin) * scale)
        lines.append(f'<text x="{LEFT - 10}" y="{y + 14}" text-anchor="end" fill="#222">{escape(span.name)}</text>')
        lines.append(f'<rect x="{x:.1f}" y="{y}" width="{width:.1f}" height="18" rx="2" fill="{COLOURS[span.place]}"/>')
        lines.append(f'<text x="{x + width + 5:.1f}" y="{y + 14}" fill="#444">{_seconds(span.end - span.begin)}</text>')
    return "\n".join([*lines, "</svg>"]) + "\n"


def _seconds(duration: float) -> str:
    return f"{1000 * duration:.0f} ms" if duration < 1 else f"{duration:.2f} s"


def lines_of(job: str, text: str) -> list[str]:
    """Return the log lines of one job, without machine-dependent path prefixes."""
    kept = [line for line in text.splitlines() if job in line]
    return [re.sub(r"/\S*/(data|incoming)/", r"\1/", line) for line in kept]


def main() -> None:
    """Run one job, draw it, print its log."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # the started processes end, too
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        with installation(folder) as url, Client(url) as client:
            job = client.submit(face(30, 500).tracks.points, mesh="none", options={"outputs": []})
            job.wait(load=False, timeout=300)
        found = [each for name in ("api", "worker") for each in read_spans((folder / f"{name}.spans").read_text())]
        (trace,) = {id for id, span in found if span.name == "attempt"}
        IMAGE.write_text(draw([span for id, span in found if id == trace]))
        for name in ("api", "worker"):
            print("\n".join(lines_of(job.id, (folder / f"{name}.log").read_text())))


if __name__ == "__main__":
    main()

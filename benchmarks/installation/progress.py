"""Compare displayed with true remaining time in thirteen runs, over HTTP and on the command line.

    python -m benchmarks.installation.progress --results benchmarks/results/progress.jsonl
    python -m benchmarks.installation.progress --only flag,sphere

Each run appends one line: the ticks as [seconds since the start, displayed seconds left], the longest time without a tick, the first tick
after a quarter of the run, and the share of ticks from there on within a factor of two of the true time, among those with 2 s or more left
(`doubled`) and among all, with 2 s of slack (`within`). Over HTTP, ticks are the events that the page follows; on the command line, the
updates that `pliant solve` writes to a terminal.
"""

from __future__ import annotations

import argparse
import os
import pty
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pliant.client import Client
from pliant.solver.gallery import Sequence, corrupt, face, flag, sphere, talk
from pliant.tracking.rendering import face_paint, render_film

from benchmarks.installation.instance import Instance
from benchmarks.rows import append_row

SHOWN = re.compile(rb"(\d+) s left")
SLACK = 2.0
"""Tolerated error of a displayed time, s: it is shown in whole seconds, and a message takes up to one."""
TICKS = 80
"""Number of ticks stored per run, evenly spaced."""


@dataclass(frozen=True, slots=True)
class Run:
    name: str
    make: Callable[[], Sequence]
    line: bool = False
    """Whether it runs on the command line."""
    options: dict[str, str] = field(default_factory=dict)
    cameras: bool = False
    """Whether the true rotations are given."""
    film: bool = False
    """Whether a rendered film is sent instead of tracks and mesh."""


RUNS = (
    Run("face", lambda: face(30, 1000, degrees=30)),
    Run("face, larger", lambda: face(60, 4000, degrees=30, scale_change=0.05), line=True),
    Run("flag", lambda: flag(40, 800, degrees=40)),
    Run("sphere", lambda: sphere(40, 1500), line=True),
    Run("outliers", lambda: corrupt(face(30, 800, degrees=40), outliers=0.08)),
    Run("hidden points", lambda: corrupt(face(60, 600, degrees=40), hidden=0.3), line=True),
    Run("few frames", lambda: face(10, 20_000, degrees=60)),
    Run("smooth prior", lambda: face(60, 10_000, degrees=40), line=True, options={"prior": "smooth"}),
    Run("known cameras", lambda: face(99, 6000, degrees=40), cameras=True),
    Run("size of the picture", lambda: face(40, 600, degrees=40), line=True, options={"image_size": "640x480"}),
    Run("film", lambda: face(30, 900, degrees=50), line=True, film=True),
    Run("many points", lambda: face(50, 100_000, degrees=40)),
    Run("many frames", lambda: talk(3000, 300), line=True),
)


def main() -> None:
    """Run all, print a table, and append one line per run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="names or parts of them, separated by commas")
    parser.add_argument("--results", type=Path, help="JSON lines to append to")
    given = parser.parse_args()
    wanted = [word for word in given.only.split(",") if word]
    print(
        "| run | size | seconds | after a quarter: shown, true | longest silence | ticks within a factor of two | or 2 s |"
    )
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch, Instance(Path(scratch) / "service", workers=1) as instance:
        for run in RUNS:
            if wanted and not any(word in run.name for word in wanted):
                continue
            row = measured(run, Path(scratch), instance)
            quarter = row["quarter"]
            print(
                f"| {run.name}, {row['door']} | {row['frames']} × {row['points']} | {row['seconds']:.0f} | {quarter[1]:.0f}, "
                f"{row['seconds'] - quarter[0]:.0f} | {row['silence']:.1f} | {row['doubled']:.0%} | {row['within']:.0%} |",
                flush=True,
            )
            if given.results is not None:
                append_row(given.results, row)


def measured(run: Run, scratch: Path, instance: Instance) -> dict[str, Any]:
    """Run once and return the row."""
    sequence = run.make()
    files = {"tracks": scratch / "tracks.npz", "mesh": scratch / "mesh.npz"}
    np.savez(files["tracks"], tracks=sequence.tracks.points, visibility=sequence.tracks.visible > 0)
    np.savez(files["mesh"], faces=sequence.mesh.faces)
    if run.film:
        files = {"tracks": scratch / "film.webm"}
        render_film(sequence, size=(320, 240), paint=face_paint(sequence.mesh.num_points)).write(files["tracks"])
    if run.cameras:
        files["rotations"] = scratch / "rotations.npz"
        np.savez(files["rotations"], rotations=sequence.rotations)
    seen = list(
        on_the_command_line(files, run.options, scratch) if run.line else over_http(files, run.options, instance)
    )
    end = seen[-1][0]
    ticks = [(at, left) for at, left in seen[:-1] if left is not None]
    later = [(at, left) for at, left in ticks if at >= end / 4]
    doubled = [0.5 <= left / (end - at) <= 2 for at, left in later if end - at >= SLACK]
    fits = [(end - at) / 2 <= left <= 2 * (end - at) or abs(left - (end - at)) <= SLACK for at, left in later]
    quarter = later[0] if later else (end, 0.0)
    frames, points = sequence.tracks.visible.shape
    chosen = sorted({round(place) for place in np.linspace(0, len(ticks) - 1, min(TICKS, len(ticks)))}) if ticks else []
    return {
        "run": run.name, "door": "command line" if run.line else "HTTP", "frames": frames, "points": points, "seconds": round(end, 1),
        "silence": round(max(after[0] - before[0] for before, after in zip([(0.0, None), *seen], seen, strict=False)), 2),
        "quarter": [round(each, 1) for each in quarter], "within": round(float(np.mean(fits)), 3) if fits else 1.0,
        "doubled": round(float(np.mean(doubled)), 3) if doubled else 1.0,
        "ticks": [[round(ticks[place][0], 1), round(ticks[place][1], 1)] for place in chosen],
        "load": round(os.getloadavg()[0], 1),
    }  # fmt: skip


def over_http(
    files: dict[str, Path], options: dict[str, str], instance: Instance
) -> Iterator[tuple[float, float | None]]:
    """Yield time and displayed seconds left for every event once the job runs; the last item is the end."""
    with Client(instance.url) as client:
        job = client.submit(**files, options=options)
        instance.acknowledged.append(job.id)
        began = None
        for now in job.events():
            if now.status == "queued":
                continue
            began = time.monotonic() if began is None else began
            left = None if now.progress is None else now.progress.seconds_left
            yield time.monotonic() - began, None if now.status.final else left


def on_the_command_line(
    files: dict[str, Path], options: dict[str, str], scratch: Path
) -> Iterator[tuple[float, float | None]]:
    """Yield time and displayed seconds left for every update that `pliant solve` writes; the last item is the end."""
    command = [sys.executable, "-m", "pliant.cli", "solve", str(files["tracks"]), "-o", str(scratch / "out"), "--force"]
    command += [f"--{name}={path}" for name, path in files.items() if name != "tracks"]
    for name, value in options.items():
        command += ["-O", f"{name}={value}"]
    here, there = pty.openpty()
    began: float | None = None
    with subprocess.Popen(command, stdout=there, stderr=there, env={**os.environ, "COLUMNS": "200"}) as process:
        os.close(there)
        while True:
            try:
                text = os.read(here, 1 << 16)
            except OSError:  # the other end is closed
                break
            if not text:
                break
            now = time.monotonic()
            shown = SHOWN.findall(text)
            if b"%" in text:
                began = now if began is None else began
                yield now - began, float(shown[-1]) if shown else None
    os.close(here)
    assert process.returncode == 0, command
    assert began is not None
    yield time.monotonic() - began, None


if __name__ == "__main__":
    main()

"""Time of a solve with BLAS in one thread, as the solver sets it, and in as many threads as BLAS uses by itself."""

from __future__ import annotations

import os
import subprocess
import sys

CASES = ((6, 40), (24, 150), (40, 300))
"""Frames and points of gallery faces."""

_SOLVE = """
import sys, time
from pliant.solver import gallery, solve, threads
if sys.argv[3] == "default":
    threads._SerialBlas.enter = threads._SerialBlas.leave = lambda self: None
case = gallery.face(int(sys.argv[1]), int(sys.argv[2]))
wall, cpu = time.perf_counter(), time.process_time()
solve(case.tracks, case.mesh)
print(time.perf_counter() - wall, time.process_time() - cpu)
"""


def blas_threads() -> None:
    """Print seconds and processor seconds of each case, each in a separate process without limits in its environment."""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    print("frames × points: wall and CPU seconds, BLAS in one thread | in its default number of threads")
    for frames, points in CASES:
        found = []
        for threads in ("one", "default"):
            command = [sys.executable, "-c", _SOLVE, str(frames), str(points), threads]
            ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            wall, cpu = map(float, ran.stdout.split())
            found.append(f"{wall:.1f} s, {cpu:.1f} s")
        print(f"{frames} × {points}: {' | '.join(found)}", flush=True)

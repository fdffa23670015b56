"""A job that is long on any machine and that tests stop. It is defined in the benchmarks, which need it too."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

_HOME = runpy.run_path(str(Path(__file__).parents[3] / "benchmarks" / "installation" / "long_jobs.py"))
LONG, long_sequence = _HOME["LONG"], _HOME["long_sequence"]


def long_request() -> dict[str, Any]:
    """Return the arguments of `Client.submit` for it."""
    sequence = long_sequence()
    return {"tracks": sequence.tracks.points, "mesh": "none", "rotations": sequence.rotations, "options": LONG}

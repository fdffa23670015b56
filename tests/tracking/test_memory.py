"""Memory of the tracker as a function of the film's length."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import films
import numpy as np
import pytest

pytestmark = pytest.mark.slow

TRACK = """
import json, resource, sys
import numpy as np
from pliant.tracking import track_film

mask = np.zeros((120, 160), np.uint8)
mask[20:100, 30:130] = 255
tracked = track_film(sys.argv[1], region=mask, template_frame=0, frames=f":{sys.argv[2]}", longest_side=160, grid_step=8, threads=1)
print(json.dumps({
    "frames": len(tracked.tracks), "points": tracked.tracks.shape[1], "visible": float(tracked.visibility.mean()),
    "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
}))
"""

BYTES = 2 * 4 + 4 + 4 + 1
"""For each frame and point: tracks, confidence and variance in single precision, and visibility."""

SLACK = 1 << 20
"""Allocator rounding. Keeping the 90 additional frames as grey pictures would take 1.7 MB, more than this."""


def swaying(frames: int) -> list[np.ndarray]:
    """A texture that sways by a few pixels."""
    wide = films.textured_pictures(1, (200, 160))[0]
    offsets = 10 * np.sin(np.arange(frames) / 9)
    return [cv2.warpAffine(wide, np.float32([[1, 0, x - 20], [0, 1, 0.4 * x - 20]]), (160, 120)) for x in offsets]


def measured(film: Path, frames: int) -> dict[str, float]:
    command = [sys.executable, "-c", TRACK, str(film), str(frames)]
    answer: dict[str, float] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return answer


def test_memory_grows_with_the_film_only_by_its_tracks(tmp_path: Path) -> None:
    film = films.write_film(tmp_path / "film.mkv", swaying(102))
    short, long = measured(film, 12), measured(film, 102)
    assert (short["frames"], long["frames"]) == (12, 102)
    assert long["visible"] > 0.9
    assert long["points"] == short["points"] > 100
    assert long["peak"] - short["peak"] < BYTES * 90 * long["points"] + SLACK

"""Measure films end to end: accuracy of tracks and shapes, and the cost of tracking.

    python -m benchmarks.films rendered [--only NAME] [--frames N] [--size WxH] [--points N] [--tracks-only] [--out FILE]
    python -m benchmarks.films recorded FOLDER [--tracks-only] [--out FILE]
    python -m benchmarks.films speed [--seconds S] [--size WxH] [--threads N] [--out FILE]

`rendered` renders gallery surfaces with texture, background, blur and noise, tracks them, and solves both the estimated and the exact
tracks of the same points; films already in FILE are skipped. `recorded` takes a folder with `film.mp4`, `mask.png` and `truth.npz`
(`frames`, `pixels (K, N, 2)`, `shapes (K, N, 3)`). The focal length is never given. `--tracks-only` solves nothing; names of its rows end
in "tracks". `speed` tracks a synthetic film of moving texture, and its first quarter, each in a separate process, and reports seconds and
peak memory. Results are appended to FILE as JSON lines.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pliant.solver import Mesh, Settings, Solution, Tracks, solve
from pliant.solver.evaluation.metrics import e3d_frame_scaled
from pliant.solver.gallery import Sequence, face, flag, sphere
from pliant.tracking import TrackedFilm, open_film, track_film
from pliant.tracking.rendering import RenderedFilm, Truth, render_film
from scipy.interpolate import LinearNDInterpolator

from benchmarks.rows import append_row, rows

SCENES: dict[str, tuple[Callable[[int], Sequence], bool]] = {
    "face": (lambda frames: face(frames, 3000, degrees=30), False),
    "flag": (lambda frames: flag(frames, 3000, degrees=30), False),
    "sphere": (lambda frames: sphere(frames, 2000, degrees=40), False),
    "face, occluder": (lambda frames: face(frames, 3000, degrees=25), True),
}
"""Surface, and whether a bar passes in front of it."""

DISTANCE = 5.0
"""Camera distance, in half heights of the object."""


def rendered(given: argparse.Namespace) -> None:
    """Measure the rendered films that the results file lacks."""
    size = _size(given.size)
    for name, (make, occluder) in SCENES.items():
        if given.only and not any(word in name for word in given.only):
            continue
        label = _label(f"{name} {given.size} F={given.frames}", given)
        if any(row["film"] == label for row in rows(given.out)):
            continue
        film = render_film(make(given.frames), size=size, distance=DISTANCE, occluder=occluder)
        _keep(given.out, {"film": label, **_end_to_end(film, 0 if given.tracks_only else given.points)})


def _label(film: str, given: argparse.Namespace) -> str:
    return f"{film} tracks" if given.tracks_only else film


def _end_to_end(film: RenderedFilm, points: int) -> dict[str, Any]:
    """Track a film; solve at most `points` of its points with estimated and exact tracks, or nothing if 0."""
    start = film.num_frames // 2
    with tempfile.TemporaryDirectory() as folder:
        path = film.write(Path(folder) / "film.mkv")
        began = time.perf_counter()
        tracked = track_film(path, region=film.region(start), region_frame=start)
        seconds = time.perf_counter() - began
    truth = Truth.of(film, tracked.tracks, tracked.template)
    accuracy = truth.track_accuracy(tracked.tracks, tracked.visibility)
    row = {
        "track_median": accuracy.median, "track_p95": accuracy.p95, "precision": accuracy.precision, "recall": accuracy.recall,
        "track_seconds": seconds, "points": tracked.tracks.shape[1],
    }  # fmt: skip
    return row if points == 0 else row | _shapes(film, tracked, truth, points)


def _shapes(film: RenderedFilm, tracked: TrackedFilm, truth: Truth, points: int) -> dict[str, Any]:
    mesh, kept = _thinned(tracked, points, truth)
    visible = np.where(tracked.visibility, tracked.confidence, 0)[:, kept]
    place = np.cumsum(truth.on) - 1
    exact, seen = truth.tracks[:, place[kept]], truth.visible[:, place[kept]]
    found = _solved(tracked.tracks[:, kept], visible, mesh, film.size)
    ideal = _solved(exact, seen, mesh, film.size)
    return {
        "points": len(kept), "e3d_frame_scaled": truth.shape_error(found.shapes, kept),
        "e3d_frame_scaled_exact_tracks": truth.shape_error(ideal.shapes, kept),
        **_focal(found, film, ""), **_focal(ideal, film, "_exact_tracks"),
    }  # fmt: skip


def _focal(solution: Solution, film: RenderedFilm, suffix: str) -> dict[str, float]:
    """Return the estimated focal length and its standard deviation, relative to the true one; nothing under orthography."""
    camera = solution.camera
    if camera.focal is None:
        return {}
    deviation = {} if camera.focal_std is None else {f"focal_std{suffix}": camera.focal_std / film.focal}
    return {f"focal_ratio{suffix}": camera.focal / film.focal, **deviation}


def _thinned(tracked: TrackedFilm, points: int, truth: Truth) -> tuple[Mesh, np.ndarray]:
    """Keep every n-th row and column of the grid, without points that are not on the object."""
    grid, stride = tracked.grid, 1
    while (grid[::stride, ::stride] >= 0).sum() > points:
        stride += 1
    coarse = grid[::stride, ::stride]
    coarse = np.where((coarse >= 0) & truth.on[np.maximum(coarse, 0)], coarse, -1)
    kept = np.sort(coarse[coarse >= 0])
    return Mesh.from_grid(np.where(coarse >= 0, np.searchsorted(kept, coarse), -1)), kept


def _solved(tracks: np.ndarray, visible: np.ndarray, mesh: Mesh, size: tuple[int, int]) -> Solution:
    settings = Settings(image_size=(float(size[0]), float(size[1])))
    return solve(Tracks.from_arrays(tracks.astype(float), visible.astype(float)), mesh, settings=settings)


def recorded(given: argparse.Namespace) -> None:
    """Measure a recorded film against points with known pixels and 3-D positions."""
    with np.load(given.folder / "truth.npz") as file:
        frames, pixels, shapes = file["frames"], file["pixels"], file["shapes"]
    began = time.perf_counter()
    tracked = track_film(given.folder / "film.mp4", region=given.folder / "mask.png")
    tracking = time.perf_counter() - began
    rows = np.searchsorted(tracked.film.frame_indices, frames)
    first = int(np.abs(rows - tracked.template).argmin())
    here = tracked.tracks[rows[first]].astype(float)
    followed = _carried(here, tracked.tracks[rows], pixels[first])
    seen = _carried(here, tracked.visibility[rows, :, None].astype(float), pixels[first])[..., 0] > 0.99
    error = np.linalg.norm(followed - pixels, axis=2)[seen]
    row = {
        "film": _label(given.folder.name, given), "track_median": float(np.median(error)),
        "track_p95": float(np.percentile(error, 95)), "kept": float(seen[:, np.isfinite(followed).all(axis=(0, 2))].mean()),
        "points": tracked.tracks.shape[1], "track_seconds": tracking,
    }  # fmt: skip
    if not given.tracks_only:
        visible = np.where(tracked.visibility, tracked.confidence, 0)
        began = time.perf_counter()
        solved = _solved(tracked.tracks, visible, Mesh.from_grid(tracked.grid), tracked.image_size).shapes
        at = _carried(here, solved[rows], pixels[first])
        on = np.isfinite(at).all(axis=(0, 2))
        row["solve_seconds"] = time.perf_counter() - began
        row["e3d_frame_scaled"] = e3d_frame_scaled(at[:, on], shapes[:, on])
    _keep(given.out, row)


def _carried(here: np.ndarray, values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Interpolate values `(K, P, C)`, given at positions `here (P, 2)`, at `places (N, 2)`; return `(K, N, C)`."""
    count, _, width = values.shape
    flat = values.transpose(1, 0, 2).reshape(len(here), -1)
    return LinearNDInterpolator(here, flat)(places).reshape(len(places), count, width).transpose(1, 0, 2)


def speed(given: argparse.Namespace) -> None:
    """Track a film and its first quarter, each in a separate process."""
    size, frames = _size(given.size), round(given.seconds * 30)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        write_moving_texture(path, size, frames)
        for count in (frames // 4, frames):
            command = [sys.executable, "-m", "benchmarks.films", "track", str(path), str(count), str(given.threads)]
            ran = subprocess.run(command, capture_output=True, text=True, check=True)
            _keep(given.out, {"film": f"moving texture {given.size}", "frames": count, **json.loads(ran.stdout)})


def write_moving_texture(path: Path, size: tuple[int, int], frames: int) -> None:
    """Write a film of blurred noise that rotates, scales and shifts smoothly, which is cheap to make at any size."""
    width, height = size
    noise = np.random.default_rng(0).standard_normal((2 * height, 2 * width, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 2.0)
    texture = np.clip(128 + 50 * noise / noise.std(), 0, 255).astype(np.uint8)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), 30.0, size)
    for frame in range(frames):
        time_ = 2 * np.pi * frame / 120
        matrix = cv2.getRotationMatrix2D((width, height), 8 * np.sin(time_), 1 + 0.1 * np.sin(0.7 * time_))
        matrix[:, 2] -= (width / 2 + 0.05 * width * np.sin(0.5 * time_), height / 2)
        writer.write(cv2.warpAffine(texture, matrix, size, flags=cv2.INTER_LINEAR))
    writer.release()


def track(given: argparse.Namespace) -> None:
    """Track the first frames of a film, save the tracks, and print the seconds of tracking and this process's peak memory as JSON."""
    import resource

    began = time.perf_counter()
    width, height = open_film(given.path).size
    region = np.zeros((height, width), np.uint8)
    cv2.ellipse(region, (width // 2, height // 2), (round(0.3 * width), round(0.38 * height)), 0, 0, 360, 255, -1)
    tracked = track_film(given.path, region=region, frames=f":{given.count}", threads=given.threads)
    seconds, cpu = time.perf_counter() - began, time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        tracked.save_npz(Path(folder) / "tracks.npz")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        json.dumps(
            {
                "points": tracked.tracks.shape[1], "threads": given.threads, "seconds": seconds, "cpu_seconds": cpu,
                "peak_mib": peak, "visible": float(tracked.visibility.mean()),
            }
        )
    )  # fmt: skip


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return int(width), int(height)


def _keep(path: Path, row: dict[str, Any]) -> None:
    rounded = {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in row.items()}
    print(json.dumps(rounded, ensure_ascii=False), flush=True)
    append_row(path, rounded)


def main(arguments: list[str] | None = None) -> None:
    """Run one of the measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    out = Path("benchmarks/results/films.jsonl")
    one = commands.add_parser("rendered")
    one.add_argument("--only", action="append", default=[], help="names that hold this word")
    one.add_argument("--frames", type=int, default=30)
    one.add_argument("--size", default="640x480")
    one.add_argument("--points", type=int, default=4000, help="points that are solved, at most")
    one.set_defaults(run=rendered)
    two = commands.add_parser("recorded")
    two.add_argument("folder", type=Path)
    two.set_defaults(run=recorded)
    for each in (one, two):
        each.add_argument("--tracks-only", action="store_true", help="solve nothing")
    three = commands.add_parser("speed")
    three.add_argument("--seconds", type=float, default=10.0)
    three.add_argument("--size", default="640x480")
    three.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    three.set_defaults(run=speed)
    for each in (one, two, three):
        each.add_argument("--out", type=Path, default=out)
    four = commands.add_parser("track")
    four.add_argument("path", type=Path)
    four.add_argument("count", type=int)
    four.add_argument("threads", type=int)
    four.set_defaults(run=track)
    given = parser.parse_args(arguments)
    given.run(given)


if __name__ == "__main__":
    main()

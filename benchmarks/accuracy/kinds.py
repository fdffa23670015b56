"""Error on kinds of objects and camera paths that constants were not chosen on: six kinds, six paths, near the camera and orthographic.

    python -m benchmarks.accuracy.kinds [--only NAME] [--distances 4,inf] [--noise PIXELS] [--surface isometric] [--out FILE]
    python -m benchmarks.accuracy.kinds --table [--out FILE]

Tracks of 60 frames and 144 points (stick figure: 41), without a mesh, in a picture of 1280 × 720 px with a half-size of 300 px. The
distance of the pinhole camera is in half-sizes. Default settings with `image_size`; the focal length is not given. Each row also has the
errors of the true images with no depth (`flat`) and of the mean true shape in every frame (`rigid`). Finished ones are not repeated.
`--surface isometric` sets that option, as someone would who knows that the object is a sheet; the table has separate rows for it.
Intervals are those stated for `e3d_frame`, which also counts a wrong size, so they should contain the errors here all the more.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pliant.solver import Settings, Tracks, solve
from pliant.solver.evaluation.metrics import e3d_frame_scaled
from pliant.solver.model.so3 import exponential
from pliant.solver.settings import Surface

from benchmarks.rows import append_row, parser_of, rows

Floats = NDArray[np.float64]

FRAMES, POINTS, NOISE = 60, 144, 0.3
"""Size of every sequence, and the noise's standard deviation in pixels."""

PICTURE, HALF_SIZE = (1280.0, 720.0), 300.0
"""Size of the picture and largest coordinate of a shape in camera axes, px."""


def along(count: int = FRAMES) -> Floats:
    """Return times from 0 to 1."""
    return np.linspace(0, 1, count)


def waves(random: np.random.Generator, columns: int, highest: int = 3) -> Floats:
    """Return sums of sine waves with random phases, shape `(F, columns)`."""
    orders = np.arange(1, highest + 1)[:, None, None]
    phases = random.uniform(0, 2 * np.pi, (highest, 1, columns))
    pace = random.uniform(0.5, 1, (highest, 1, columns))
    sizes = random.normal(size=(highest, 1, columns)) / orders
    return np.asarray((sizes * np.sin(2 * np.pi * orders * pace * along()[:, None] + phases)).sum(axis=0))


def turned(axis: tuple[float, float, float] | Floats, angles: Floats) -> Floats:
    """Return rotations about an axis, shape `(F, 3, 3)`."""
    unit = np.asarray(axis) / np.linalg.norm(axis)
    return exponential(angles[:, None] * unit)


def grid(height: float) -> tuple[Floats, Floats]:
    """Return coordinates from −1 to 1 across and −height to height along a sheet, shape `(P,)` each."""
    side = int(POINTS**0.5)
    across, down = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-height, height, side))
    return across.ravel(), down.ravel()


def arm(random: np.random.Generator) -> Floats:
    """Three boxes in a row; the outer ones turn about hinges."""
    box, hinge = random.uniform(-1, 1, (POINTS // 3, 3)) * [0.5, 0.12, 0.12], np.array([0.5, 0, 0])
    right, left = turned((0, 0, 1), 0.7 * waves(random, 1)[:, 0]), turned((0.3, 1, 0.2), 0.7 * waves(random, 1)[:, 0])
    return np.concatenate(
        [
            (box - hinge) @ left.transpose(0, 2, 1) - hinge,
            np.broadcast_to(box, (FRAMES, *box.shape)),
            (box + hinge) @ right.transpose(0, 2, 1) + hinge,
        ],
        axis=1,
    )


def balloon(random: np.random.Generator) -> Floats:
    """An ellipsoid that swells and shrinks unevenly."""
    index = np.arange(POINTS) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / POINTS), np.pi * (1 + 5**0.5) * index
    unit = np.column_stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    size = 1 + 0.4 * np.sin(2 * np.pi * along())[:, None] * (1 + 0.5 * unit[:, 0] * unit[:, 2])
    size = size + 0.1 * waves(random, 1) * unit[:, 1]
    return np.asarray(size[..., None] * unit * [1, 0.8, 0.7])


def paper(random: np.random.Generator) -> Floats:  # noqa: ARG001 - as the others
    """A sheet rolled about an axis that turns in the sheet; lengths on it are constant."""
    across, down = grid(0.7)
    frames = []
    for bend, angle in zip(1.2 * np.sin(np.linspace(0.3, 5, FRAMES)), 0.5 * np.sin(3 * along()), strict=True):
        cosine, sine = np.cos(angle), np.sin(angle)
        rolled, kept = across * cosine + down * sine, down * cosine - across * sine
        arc, depth = np.sin(bend * rolled) / bend, (1 - np.cos(bend * rolled)) / bend
        frames.append(np.column_stack([arc * cosine - kept * sine, arc * sine + kept * cosine, depth]))
    return np.stack(frames)


def stretching(random: np.random.Generator) -> Floats:  # noqa: ARG001 - as the others
    """A curved sheet that stretches across and along by a third."""
    across, down = grid(1.0)
    wide = 1 + 0.35 * np.sin(2 * np.pi * along())[:, None]
    high = 1 + 0.3 * np.cos(3 * np.pi * along())[:, None]
    twist = 0.25 * np.sin(4 * along())[:, None] * across * down
    return np.stack([wide * across, high * down, 0.3 * np.cos(1.5 * across) * np.cos(1.2 * down) + twist], axis=2)


def tearing(random: np.random.Generator) -> Floats:  # noqa: ARG001 - as the others
    """A curved sheet that tears in the middle, from one end; its halves move apart."""
    across, down = grid(1.0)
    side = np.where(across > 0, 1.0, -1.0)
    gap = 0.8 * np.clip(1.5 * along() - 0.3, 0, 1)[:, None] * (down + 1) / 2
    depth = 0.3 * np.cos(1.5 * across) * np.cos(down) + 0.5 * side * gap
    return np.stack([across * np.cos(0.3 * gap) + 0.25 * side * gap, np.broadcast_to(down, gap.shape), depth], axis=2)


def figure(random: np.random.Generator) -> Floats:
    """A stick figure with two arms and two legs of two links each, and a head."""
    hip = np.zeros((FRAMES, 3))
    neck = np.array([0, 0.55, 0]) + 0.05 * waves(random, 3)
    points = [hip, neck, (hip + neck) / 2 + 0.1, hip + np.array([0.15, 0, 0.05]), hip + np.array([-0.15, 0, 0.05])]

    def limb(origin: Floats, direction: list[float], length: float, links: int, swing: float) -> None:
        end, rotation = origin, np.broadcast_to(np.eye(3), (FRAMES, 3, 3))
        for _ in range(links):
            rotation = rotation @ turned(random.normal(size=3), swing * waves(random, 1, 4)[:, 0])
            step = length * (rotation @ np.array(direction))
            points.extend(
                end + step * share + 0.05 * (rotation @ random.normal(size=3)) for share in (0.25, 0.5, 0.75, 1)
            )
            end = end + step

    limb(neck, [0, 1, 0], 0.25, 1, 0.3)
    for side in (1, -1):
        limb(neck + side * np.array([0.2, 0, 0]), [side, 0, 0], 0.3, 2, 0.5)
        limb(hip + side * np.array([0.12, 0, 0]), [0, -1, 0], 0.45, 2, 0.35)
    return np.stack(points, axis=1)


KINDS: dict[str, Callable[[np.random.Generator], Floats]] = {
    "arm": arm, "balloon": balloon, "paper": paper, "stretching": stretching, "tearing": tearing, "figure": figure,
}  # fmt: skip
"""Points over time, `(F, P, 3)`, by kind."""

PATHS: dict[str, tuple[Floats, Floats]] = {
    "circle": (20 + 5 * np.sin(6 * along()), 360 * along()),
    "half circle": (10 * np.sin(3 * along()), 180 * along() - 90),
    "flyby": (15 + 30 * along(), 80 * along() - 40),
    "zigzag": (25 * np.sin(4 * np.pi * along()), 25 * np.sin(6 * np.pi * along())),
    "line": (5 * along(), 50 * along() - 25),
    "pause": (
        20 * np.clip(3 * along() - 1, 0, 1),
        60 * np.clip(3 * along(), 0, 1) - 60 * np.clip(3 * along() - 2, 0, 1),
    ),
}
"""Nod and turn of the camera in degrees, by path."""


def sequence(kind: str, path: str, distance: float, noise: float) -> tuple[Tracks, Floats]:
    """Return tracks in pixels, and the true shapes in camera axes, `(F, P, 3)`, pixels."""
    random = np.random.default_rng(5)
    shapes = KINDS[kind](random)
    nod, turn = np.radians(PATHS[path])
    cameras = turned((1, 0, 0), nod) @ turned((0, 1, 0), turn)
    seen = (shapes - shapes.mean(axis=1, keepdims=True)) @ cameras.transpose(0, 2, 1)
    seen = seen * (HALF_SIZE / np.abs(seen).max())
    images = (np.array(PICTURE) - 1) / 2 + seen[..., :2] / (1 + seen[..., 2:] / (HALF_SIZE * distance))
    return Tracks.from_arrays(images + noise * random.normal(size=images.shape)), seen


def measured(kind: str, path: str, distance: float, noise: float, surface: Surface = "auto") -> dict[str, Any]:
    """Solve one sequence with the option `surface` and return its row."""
    tracks, truth = sequence(kind, path, distance, noise)
    began = time.perf_counter()
    found = solve(tracks, settings=Settings(image_size=PICTURE, surface=surface))
    rigid = KINDS[kind](np.random.default_rng(5)).mean(axis=0)
    focal = found.camera.focal
    return {
        "kind": kind, "path": path, "option": surface, "distance": distance if np.isfinite(distance) else None, "noise": noise,
        "e3d_frame_scaled": e3d_frame_scaled(found.shapes, truth),
        "flat": e3d_frame_scaled(truth * [1, 1, 0], truth),
        "rigid": e3d_frame_scaled(np.broadcast_to(rigid, truth.shape), truth),
        "focal_error": None if focal is None or not np.isfinite(distance) else abs(focal / (HALF_SIZE * distance) - 1),
        "verdict": None if found.trust is None else found.trust.verdict.value,
        "expected_error": None if found.trust is None else found.trust.expected_error,
        "interval": None if found.trust is None else found.trust.interval,
        "surface": found.choices.reasons.get("surface", ""), "seconds": time.perf_counter() - began,
    }  # fmt: skip


def table(found: list[dict[str, Any]]) -> str:
    """Return Markdown: one row per kind, option and distance, one column per path; errors, in brackets the better of `flat` and `rigid`."""
    lines = ["| kind | d | " + " | ".join(PATHS) + " |", "|---" * (2 + len(PATHS)) + "|"]
    by_place = {(row["kind"], row["option"], row["distance"], row["path"]): row for row in found}
    for kind, option, distance in sorted(
        {key[:3] for key in by_place}, key=lambda key: (list(KINDS).index(key[0]), key[1], key[2] or np.inf)
    ):
        cells = [by_place.get((kind, option, distance, path)) for path in PATHS]
        texts = [
            "" if cell is None else f"{_short(cell['e3d_frame_scaled'])} ({_short(min(cell['flat'], cell['rigid']))})"
            for cell in cells
        ]
        name = kind if option == "auto" else f"{kind}, `surface={option}`"
        lines.append(f"| {name} | {'∞' if distance is None else f'{distance:g}'} | " + " | ".join(texts) + " |")
    return "\n".join(lines)


def of_intervals(found: list[dict[str, Any]]) -> str:
    """Return a sentence on how many errors of the default settings lie in the intervals that the solver states."""
    default = [row for row in found if row["option"] == "auto"]
    stated = [row for row in default if row["interval"] is not None]
    good = [row for row in stated if row["verdict"] == "good"]
    above = sum(row["e3d_frame_scaled"] > row["interval"][1] for row in stated)
    by_kind = {kind: [row for row in stated if row["kind"] == kind] for kind in KINDS}
    each = ", ".join(f"{kind} {_inside(some)} of {len(some)}" for kind, some in by_kind.items() if some)
    return (
        f"With default settings, the interval contains the error in {_inside(stated)} of {len(stated)} solves, and in {_inside(good)} of "
        f"{len(good)} with the verdict good; in {above} the error is larger. Solves without an interval: {len(default) - len(stated)}. "
        f"By kind: {each}."
    )


def _inside(stated: list[dict[str, Any]]) -> int:
    return sum(row["interval"][0] <= row["e3d_frame_scaled"] <= row["interval"][1] for row in stated)


def _short(value: float) -> str:
    return f"{value:.3f}".removeprefix("0")


def main(arguments: list[str] | None = None) -> None:
    """Measure what is missing, or print the table."""
    parser = parser_of(__doc__, out=Path("benchmarks/results/kinds.jsonl"))
    parser.add_argument("--distances", default="4,inf", help="half-sizes, comma-separated")
    parser.add_argument("--surface", default="auto", choices=("auto", "isometric", "free"), help="option of the solver")
    parser.add_argument("--noise", type=float, default=NOISE, help="standard deviation, px")
    parser.add_argument("--table", action="store_true", help="print the table of the results file")
    given = parser.parse_args(arguments)
    if given.table:
        found = [row for row in rows(given.out) if row["noise"] == given.noise]
        print(table(found), of_intervals(found), sep="\n\n")
        return
    done = {(row["kind"], row["path"], row["distance"], row["noise"], row["option"]) for row in rows(given.out)}
    for kind in KINDS:
        for path in PATHS:
            if given.only and not any(word in f"{kind} {path}" for word in given.only):
                continue
            for distance in (float(each) for each in given.distances.split(",")):
                if (kind, path, distance if np.isfinite(distance) else None, given.noise, given.surface) in done:
                    continue
                row = measured(kind, path, distance, given.noise, given.surface)
                append_row(given.out, row)
                print(
                    f"{kind:10} {path:11} d = {distance:<4g} {row['e3d_frame_scaled']:.4f} "
                    f"flat {row['flat']:.3f} rigid {row['rigid']:.3f} {row['verdict']} {row['seconds']:.0f} s",
                    flush=True,
                )  # fmt: skip


if __name__ == "__main__":
    main()

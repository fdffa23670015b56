"""Draw input tracks, truth and reconstruction side by side at several frames, with the error as colour.

    python -m benchmarks.figures.pictures                              the gallery
    python -m benchmarks.figures.pictures --data DIR --only face --frames 4
    python -m benchmarks.figures.pictures --data DIR --only samba --at 0,40,80 --camera film --full 40
    python -m benchmarks.figures.pictures --outliers .1 --side 50

Surfaces are seen from `--side` degrees beside the mean camera, or with `--camera film` beside each frame's own camera. Without truth, only
the reconstruction is drawn, coloured by its reprojection residual. Needs matplotlib (`pip install matplotlib`) for layout and labels;
`benchmarks.figures.shading` draws the surfaces.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from pliant.solver import Mesh, Settings, Solution, Tracks, solve
from pliant.solver.evaluation.alignment import align, frobenius
from pliant.solver.evaluation.metrics import e3d_sequence
from pliant.solver.gallery import corrupt_tracks
from pliant.solver.model.so3 import nearest

from benchmarks.accuracy.cells import parse_settings
from benchmarks.figures.shading import draw_mesh, draw_points
from benchmarks.rows import words
from benchmarks.sequences import Case, cases

mpl.use("Agg")
from matplotlib import pyplot as plt

SIZE = (340, 340)
FILL = 0.92
"""Share of a picture that the largest frame fills."""

FULL_OF_TRUTH, FULL_OF_RESIDUAL = 15.0, 3.0
"""Errors that get the brightest colour by default, per cent of the RMS radius."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A sequence to draw: x right, y down, z away from the viewer."""

    ours: np.ndarray
    """Shape (F, P, 3)."""

    truth: np.ndarray | None
    """Shape (F, P, 3), ours aligned to it as `e3d_frame` does; or None."""

    share: np.ndarray
    """Shape (F, P), the error as a share of the frame's RMS radius."""

    quantity: str
    """Name of the quantity in `share`."""

    relative: np.ndarray | None
    """Shape (F,), relative error of every frame; None without truth."""


def main() -> None:
    """Solve and draw."""
    options = _parser().parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for case in cases(options.data, points=options.points, visibility=options.visibility, only=options.only):
        tracks, _ = corrupt_tracks(case.tracks, noise=options.noise, outliers=options.outliers, hidden=options.hidden)
        case = replace(case, tracks=tracks)
        settings = replace(Settings(), **parse_settings(options.settings))
        began = time.perf_counter()
        solution = solve(case.tracks, case.mesh, settings=settings)
        seconds = time.perf_counter() - began
        scene = scene_of(case, solution, fixed=options.camera == "fixed", side=options.side)
        frames = options.at or np.linspace(0, len(scene.share) - 1, options.frames).round().astype(int).tolist()
        path = options.out / f"{case.name}.png"
        view = f"{options.side:.0f}° aside" if options.camera == "film" else f"fixed, {options.side:.0f}° aside"
        picture(case, scene, path, frames=frames, full=options.full, view=view, title=title(case, solution, seconds))
        print(f"{path}  {title(case, solution, seconds)}")


def scene_of(case: Case, solution: Solution, *, fixed: bool, side: float) -> Scene:
    """Rotate reconstruction and truth to a view from `side` degrees beside the mean camera, or beside each frame's own camera."""
    if case.shapes is None:
        ours, truth, relative = solution.shapes, None, None
        turns, error, quantity = solution.camera.rotations, solution.residuals, "reprojection residual"
        size = solution.camera.scales
    else:
        aligned = align(solution.shapes, case.shapes, kind="frame")
        ours, truth, relative = aligned.shapes, aligned.truth, aligned.relative
        turns = np.tile(np.eye(3), (len(ours), 1, 1)) if case.cameras is None else case.cameras.rotations
        error, quantity, size = aligned.distances, "distance from the truth", 1.0
    whole = ours if truth is None else truth
    radius = size * frobenius(whole) / np.sqrt(whole.shape[1])
    if fixed:
        turns = np.broadcast_to(nearest(turns.sum(axis=0)), turns.shape)
    flip = np.diag([1.0, -1.0, -1.0]) if case.y_up else np.eye(3)
    views = (_turn(side) @ flip @ turns).transpose(0, 2, 1)
    return Scene(ours @ views, None if truth is None else truth @ views, error / radius[:, None], quantity, relative)


def picture(
    case: Case, scene: Scene, path: Path, *, frames: list[int], full: float | None, view: str, title: str
) -> None:
    """Draw one row per frame: input tracks, truth, reconstruction, and the reconstruction coloured by its error.

    All columns but the first share one view and one scale; errors of `full` per cent of the RMS radius and above get the brightest colour.
    """
    full = full or (FULL_OF_RESIDUAL if scene.truth is None else FULL_OF_TRUTH)
    largest = scene.ours if scene.truth is None else scene.truth
    scale = FILL * min(SIZE) / (2 * np.abs(largest[frames, :, :2]).max())
    colours = plt.get_cmap("viridis")
    titles = [
        "input tracks",
        *([] if scene.truth is None else [f"truth, {view}"]),
        f"ours, {view}",
        "its error as colour",
    ]
    figure, axes = plt.subplots(
        len(frames), len(titles), figsize=(len(titles) * 2.7 + 0.9, len(frames) * 2.7 + 0.8), squeeze=False, layout="constrained"
    )  # fmt: skip
    for row, frame in zip(axes, frames, strict=True):
        paint = colours(np.clip(100 * scene.share[frame] / full, 0, 1))[:, :3]
        drawings = [_tracks(case, frame)]
        if scene.truth is not None:
            drawings.append(_surface(scene.truth[frame], case.mesh, scale, None))
        drawings += [
            _surface(scene.ours[frame], case.mesh, scale, None),
            _surface(scene.ours[frame], case.mesh, scale, paint),
        ]
        for cell, image in zip(row, drawings, strict=True):
            cell.imshow(image, interpolation="lanczos")
            cell.set_axis_off()
        row[0].text(0.02, 0.02, f"frame {frame}", transform=row[0].transAxes, fontsize=9)
        if scene.relative is not None:
            row[-1].text(
                0.98, 0.02, f"{scene.relative[frame]:.3f}", transform=row[-1].transAxes, ha="right", fontsize=9
            )
    for cell, title in zip(axes[0], titles, strict=True):
        cell.set_title(title, fontsize=10)
    scalar = mpl.cm.ScalarMappable(mpl.colors.Normalize(0, full), colours)
    figure.colorbar(scalar, ax=axes, shrink=0.6, label=f"{scene.quantity}, % of the RMS radius")
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def title(case: Case, solution: Solution, seconds: float) -> str:
    """Return one line with the sequence's name and size, the time, and the errors."""
    frames, points, _ = solution.shapes.shape
    said = f"{case.name}, {frames} × {points}, {1 - (case.tracks.visible > 0).mean():.0%} hidden, {seconds:.0f} s"
    if case.shapes is None:
        return said
    whole = "" if case.cameras is None else f", e3d_sequence {e3d_sequence(solution.shapes, case.shapes):.4f}"
    frame = align(solution.shapes, case.shapes, kind="frame").relative.mean()
    return f"{said}, e3d_frame {frame:.4f}{whole}"


def _tracks(case: Case, frame: int) -> np.ndarray:
    """Draw the visible tracks at their own scale: their unit may differ from the truth's, and outliers must not shrink them."""
    tracks: Tracks = case.tracks
    seen = tracks.visible > 0
    middles = [
        np.median(points[some], axis=0) if some.any() else np.zeros(2)
        for points, some in zip(tracks.points, seen, strict=True)
    ]
    reach = np.quantile(np.abs(tracks.points - np.array(middles)[:, None])[seen], 0.995)
    flip = np.array([1.0, -1.0]) if case.y_up else np.ones(2)
    radius = 0 if tracks.num_points > 1500 else 1
    placed = (tracks.points[frame][seen[frame]] - middles[frame]) * flip
    return draw_points(placed, size=SIZE, scale=FILL * min(SIZE) / (2.2 * reach), radius=radius)


def _surface(points: np.ndarray, mesh: Mesh | None, scale: float, colours: np.ndarray | None) -> np.ndarray:
    if mesh is None:
        return draw_points(points, size=SIZE, scale=scale, colours=colours, radius=2)
    return draw_mesh(points, mesh.faces, size=SIZE, scale=scale, colours=colours)


def _turn(degrees: float) -> np.ndarray:
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)

    parser.add_argument("--data", type=Path)
    parser.add_argument("--points", type=int)
    parser.add_argument("--visibility", choices=("file", "all"), default="file")
    parser.add_argument("--only", type=words, default=[])
    parser.add_argument("--frames", type=int, default=4, help="how many, evenly spread")
    parser.add_argument(
        "--at", type=lambda text: [int(word) for word in words(text)], help="which frames, e.g. 0,40,80"
    )
    parser.add_argument(
        "--camera", choices=("fixed", "film"), default="fixed", help="where surfaces are seen from: one place, or beside each camera"
    )  # fmt: skip
    parser.add_argument("--side", type=float, default=30.0, help="degrees aside from the camera, where depth shows")
    parser.add_argument("--full", type=float, help="per cent of the RMS radius that get the brightest colour")
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--outliers", type=float, default=0.0)
    parser.add_argument("--hidden", type=float, default=0.0)
    parser.add_argument("--settings", default="", help="name=value,…")
    parser.add_argument("--out", type=Path, default=Path("build/benchmarks/pictures"))
    return parser


if __name__ == "__main__":
    main()

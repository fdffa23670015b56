"""Pictures: input tracks, ours and the truth side by side, the error as colour.

    python -m benchmarks.pictures                              the gallery
    python -m benchmarks.pictures --data DIR --only face --frames 4
    python -m benchmarks.pictures --outliers .1 --side 50

Needs matplotlib (`pip install matplotlib`) for the frame around the drawings; the drawings are `benchmarks.raster`'s.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from pliant.solver import Mesh, Settings, Solution, Tracks, solve
from pliant.solver.alignment import align, frobenius
from pliant.solver.gallery import corrupt_tracks

from benchmarks.cells import parse_settings
from benchmarks.raster import draw_mesh, draw_points
from benchmarks.sequences import Case, cases

mpl.use("Agg")
from matplotlib import pyplot as plt

SIZE = (300, 300)
FILL = 0.86
"""Share of the picture that the largest frame fills."""


def main() -> None:
    """Solve and draw."""
    options = _parser().parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for case in cases(options.data, points=options.points, visibility=options.visibility, only=options.only):
        if case.shapes is None or (case.mesh is None and not options.draw_points):
            continue
        tracks, _ = corrupt_tracks(case.tracks, noise=options.noise, outliers=options.outliers, hidden=options.hidden)
        case = replace(case, tracks=tracks)
        settings = replace(Settings(), **parse_settings(options.settings))
        solution = solve(case.tracks, case.mesh, settings=settings)
        path = options.out / f"{case.name}.png"
        error = picture(case, solution, path, count=options.frames, side=options.side, full=options.full / 100)
        print(f"{path}  e3d_frame {error:.4f}")


def picture(case: Case, solution: Solution, path: Path, *, count: int, side: float, full: float) -> float:
    """Draw some frames of one sequence; returns e3d_frame.

    One row a frame: the tracks as they came in; reconstruction and truth turned sideways by `side` degrees from the
    camera, where depth shows; the reconstruction from the front, coloured by the distance from the truth as a share of
    the frame's RMS radius, `full` and above as the brightest colour.
    """
    assert case.shapes is not None
    aligned = align(solution.shapes, case.shapes, kind="frame")
    radius = frobenius(aligned.truth) / np.sqrt(aligned.truth.shape[1])
    share = aligned.distances / radius[:, None]
    flip = np.array([1.0, -1.0, -1.0]) if case.y_up else np.ones(3)
    turns = np.tile(np.eye(3), (len(share), 1, 1)) if case.cameras is None else case.cameras.rotations
    ours, truth = (shapes @ turns.transpose(0, 2, 1) * flip for shapes in (aligned.shapes, aligned.truth))
    frames = np.linspace(0, len(share) - 1, count).round().astype(int)
    scale = FILL * min(SIZE) / (2 * np.abs(truth[frames]).max())
    colours = plt.get_cmap("viridis")
    figure, axes = plt.subplots(
        count, 4, figsize=(4 * 2.6 + 0.9, count * 2.6 + 0.5), squeeze=False, layout="constrained"
    )
    for row, frame in zip(axes, frames, strict=True):
        paint = colours(np.clip(share[frame] / full, 0, 1))[:, :3]
        drawings = (
            _tracks(case.tracks, frame, flip, scale),
            _surface(truth[frame] @ _turn(side).T, case.mesh, scale, None),
            _surface(ours[frame] @ _turn(side).T, case.mesh, scale, None),
            _surface(ours[frame], case.mesh, scale, paint),
        )
        for cell, image in zip(row, drawings, strict=True):
            cell.imshow(image, interpolation="lanczos")
            cell.set_axis_off()
        row[3].text(0.98, 0.02, f"{aligned.relative[frame]:.3f}", transform=row[3].transAxes, ha="right", fontsize=9)
    titles = ("input tracks", f"truth, {side:.0f}° aside", "ours, the same view", "ours, error as colour")
    for cell, title in zip(axes[0], titles, strict=True):
        cell.set_title(title, fontsize=11)
    scalar = mpl.cm.ScalarMappable(mpl.colors.Normalize(0, 100 * full), colours)
    figure.colorbar(scalar, ax=axes, shrink=0.6, label="distance from the truth, % of the RMS radius")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return float(aligned.relative.mean())


def _tracks(tracks: Tracks, frame: int, flip: np.ndarray, scale: float) -> np.ndarray:
    seen = tracks.visible[frame] > 0
    middle = np.median(tracks.points[frame][seen], axis=0)
    return draw_points((tracks.points[frame][seen] - middle) * flip[:2], size=SIZE, scale=scale, radius=0)


def _surface(points: np.ndarray, mesh: Mesh | None, scale: float, colours: np.ndarray | None) -> np.ndarray:
    if mesh is None:
        return draw_points(points, size=SIZE, scale=scale, colours=colours, radius=2)
    return draw_mesh(points, mesh.faces, size=SIZE, scale=scale, colours=colours)


def _turn(degrees: float) -> np.ndarray:
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)

    def words(text: str) -> list[str]:
        return [word for word in text.split(",") if word]

    parser.add_argument("--data", type=Path)
    parser.add_argument("--points", type=int)
    parser.add_argument("--visibility", choices=("file", "all"), default="file")
    parser.add_argument("--only", type=words, default=[])
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--side", type=float, default=45.0, help="degrees aside, for the views of depth")
    parser.add_argument(
        "--full", type=float, default=15.0, help="per cent of the RMS radius that get the brightest colour"
    )
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--outliers", type=float, default=0.0)
    parser.add_argument("--hidden", type=float, default=0.0)
    parser.add_argument("--settings", default="", help="name=value,…")
    parser.add_argument("--draw-points", action="store_true", help="also sequences without a mesh, as points")
    parser.add_argument("--out", type=Path, default=Path("build/benchmarks/pictures"))
    return parser


if __name__ == "__main__":
    main()

"""A complete result without solving: a waving sheet as solution and truth, for tests of written files."""

from __future__ import annotations

import errno
import hashlib
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pliant.schemas.job import Interpretation
from pliant.schemas.options import Options
from pliant.solver import Camera, Choices, Mesh, Outcome, Solution, Trace, Tracks
from pliant.solver.evaluation.trust import assess
from pliant.worker.artifacts import build_report, write_artifacts
from pliant.worker.artifacts.preview import write_preview
from pliant.worker.artifacts.result import Result
from pliant.worker.formats import GroundTruth, Inputs, Texture
from scipy.spatial.transform import Rotation


def moving_sheet(frames: int, rows: int, columns: int) -> np.ndarray:
    """Shapes (F, P, 3): a sheet in pixels, bent by two travelling waves."""
    y, x = np.mgrid[:rows, :columns].astype(float)
    time = np.arange(frames)[:, None, None] / 10
    z = 2.0 * np.sin(x / 3 + time) + np.cos(y / 4 - 2 * time) * np.sin(time)
    shapes = np.stack(np.broadcast_arrays(10 * x + 0.3 * z, 10 * y - 0.2 * z, 10 * z), axis=-1).reshape(frames, -1, 3)
    return shapes - shapes.mean(axis=1, keepdims=True)


def make_result(
    frames: int = 7,
    rows: int = 5,
    columns: int = 6,
    *,
    mesh: str = "grid",
    y_axis: str = "down",
    truth: bool = False,
    hidden: bool = False,
    std: bool = True,
    texture: bool = False,
    **options: Any,
) -> tuple[Inputs, Solution, Options]:
    """Return inputs and their solution.

    `mesh` is grid, triangles or none; with `truth` the result is off by a smooth error; with `hidden` a third of the observations and
    the whole of point 3 and frame 2 are hidden; without `std` the solver has estimated no deviations.
    """
    shapes = moving_sheet(frames, rows, columns)
    points = rows * columns
    grid = Mesh.from_grid(np.arange(points).reshape(rows, columns))
    split = np.concatenate([grid.faces[:, [0, 1, 2]], grid.faces[:, [0, 2, 3]]])
    surface = {"grid": grid, "triangles": Mesh.from_faces(split, points), "none": None}[mesh]
    interpretation = Interpretation(
        num_frames=frames, num_points=points, num_faces=0 if surface is None else len(surface.faces), hidden_fraction=0.0,
        mesh_source=mesh, has_ground_truth=False, has_rotations=False, layout="tracks (F, P, 2)", y_axis=y_axis,
    )  # fmt: skip
    visible = np.ones((frames, points))
    if hidden:
        visible = np.random.default_rng(0).choice([0.0, 0.5, 1.0], (frames, points))
        visible[:, 3], visible[2] = 0, 0
    known = GroundTruth.from_arrays(shapes + _off(frames, points), None, like=(frames, points)) if truth else None
    inputs = Inputs(Tracks.from_arrays(shapes[..., :2] + 100, visible), surface, known, None, interpretation)
    solution = Solution(
        shapes=shapes,
        camera=Camera(np.tile(np.eye(3), (frames, 1, 1)), np.ones(frames), np.full((frames, 2), 100.0)),
        residuals=np.linspace(0, 1, frames * points).reshape(frames, points) * (visible > 0),
        weights=1.0 * (visible > 0),
        trace=Trace(np.array([3.0, 2.0]), np.array([1.0, 0.5]), np.array([0, 9], dtype=np.int32)),
        outcome=Outcome.CONVERGED,
        choices=Choices(
            basis_size=2, temporal_weight=0.1, spatial_weight=0.2, robust_scale=0.01, temporal_order=1, low_rank_weight=0.0,
            laplacian="grid8", unit=30.0, noise=float("nan"), reasons={"basis_size": "Two shapes explain it."}, warnings=("Look.",),
        ),
        seconds={"cameras": 0.5},
        inlier_probability=np.where(visible > 0, 0.9, np.nan),
    )  # fmt: skip
    spread = np.linspace(0.5, 2.0, frames * points).reshape(frames, points) if std else None
    turned = Rotation.from_rotvec(np.linspace(0, 0.8, frames)[:, None] * [0, 1, 0]).as_matrix()
    solution = replace(solution, shapes_std=spread)
    trust = assess(
        replace(solution, camera=replace(solution.camera, rotations=turned)), visible, held_out_error=None, ordered=True, planar=False,
        modes=0, depth_is_typical=False, shown=np.ones(frames, dtype=bool), unclear_camera=None,
    )  # fmt: skip
    solution = replace(solution, trust=trust)
    if texture:
        inputs = replace(inputs, texture=make_texture(rows, columns))
    return inputs, solution, Options(**options)


def write(directory: Path, made: tuple[Inputs, Solution, Options]) -> dict[str, Path]:
    """Write all files of a result, compare each with its record, and return their paths by name."""
    inputs, solution, options = made
    report = build_report(inputs, solution, options, metrics={"e3d_frame": 0.5, "rotation_degrees": float("inf")})
    written = write_artifacts(inputs, solution, options, report, directory)
    for artifact in written:
        content = (directory / artifact.name).read_bytes()
        assert artifact.bytes == len(content)
        assert artifact.sha256 == hashlib.sha256(content).hexdigest()
        assert artifact.media_type
        assert artifact.description
    assert {path.name for path in directory.iterdir()} == {artifact.name for artifact in written}
    return {artifact.name: directory / artifact.name for artifact in written}


def preview_of(
    tracks: Tracks,
    solution: Solution,
    *,
    mesh: Mesh | None = None,
    truth: np.ndarray | None = None,
    texture: Texture | None = None,
    frame_times: np.ndarray | None = None,
    y_axis: str = "down",
    **options: Any,
) -> bytes:
    """Return `preview.bin` of a result."""
    frames, points = tracks.points.shape[:2]
    interpretation = Interpretation(
        num_frames=frames, num_points=points, num_faces=0, hidden_fraction=0.0, mesh_source="none", has_ground_truth=truth is not None,
        has_rotations=False, layout="tracks (F, P, 2)", y_axis=y_axis,
    )  # fmt: skip
    known = None if truth is None else GroundTruth(truth)
    inputs = Inputs(tracks, mesh, known, None, interpretation, texture=texture, frame_times=frame_times)
    into = io.BytesIO()
    write_preview(Result(inputs, solution, Options(**options)), into)
    return into.getvalue()


def disk_full(*_: object, **__: object) -> None:
    """Fail in place of a function that writes."""
    raise OSError(errno.ENOSPC, "No space left on device")


def make_texture(rows: int, columns: int) -> Texture:
    """A smooth picture, red from left to right and green from top to bottom, with a place for each point of a sheet's grid."""
    y, x = np.mgrid[0:96, 0:128]
    picture = np.stack([255 * x / 127, 255 * y / 95, 0 * x + 128.0], axis=-1)
    down, right = np.mgrid[0:rows, 0:columns].reshape(2, -1)
    uv = np.column_stack([0.1 + 0.8 * right / columns, 0.2 + 0.7 * down / rows])
    return Texture.from_tracked(np.rint(picture).astype(np.uint8), uv)


def _off(frames: int, points: int) -> np.ndarray:
    """Return truth minus result: depth that grows from the first point to the last and from frame to frame."""
    return np.linspace(0, 1, frames)[:, None, None] * np.linspace(0, 3, points)[:, None] * np.array([0.0, 0.0, 1.0])

"""Sequences to measure: recorded ones from a directory, or the gallery's."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pliant.solver import KnownCamera, Mesh, Tracks
from pliant.solver.gallery import Sequence, face, flag, sphere

from benchmarks.subsample import thin_mesh, thin_points


@dataclass(frozen=True, slots=True)
class Case:
    """One sequence, with the available truth."""

    name: str
    tracks: Tracks
    mesh: Mesh | None
    shapes: np.ndarray | None
    """True shapes (F, P, 3), or None."""
    cameras: KnownCamera | None
    """True cameras, or None; the truth is then in each frame's camera axes, and only per-frame metrics are valid."""
    y_up: bool = False
    """Whether y points up, as in some recorded sequences; pictures flip it."""


GALLERY = {
    "face": lambda points: face(60, points or 5000, degrees=30, scale_change=0.05),
    "face_few_frames": lambda points: face(12, points or 5000, degrees=90),
    "flag": lambda points: flag(60, points or 4000, degrees=40),
    "sphere": lambda points: sphere(60, points or 3000),
}


RECONSTRUCTED = ("dinosaur_real",)
"""Sequences whose shapes are another method's reconstruction: the trajectory basis with K = 12 reproduces them to .00002."""


def cases(data: Path | None, *, points: int | None, visibility: str, only: list[str]) -> Iterator[Case]:
    """Yield the sequences whose name contains one of `only`, or all if it is empty."""
    if data is None:
        for name, make in GALLERY.items():
            if wanted(name, only):
                yield as_given(from_gallery(make(points), name), visibility)
        return
    for folder in sorted(path.parent for path in data.glob("*/tracks.npz")):
        if wanted(folder.name, only):
            yield thin(as_given(read_case(folder), visibility), points)


def wanted(name: str, only: list[str]) -> bool:
    """Return whether the name contains one of the words; True if there are none."""
    return not only or any(word in name for word in only)


def from_gallery(sequence: Sequence, name: str) -> Case:
    """Wrap a sequence of the gallery."""
    cameras = KnownCamera.from_arrays(sequence.rotations, sequence.scales)
    return Case(name, sequence.tracks, sequence.mesh, sequence.shapes, cameras)


def rolled_sheet(frames: int = 12, *, bend: tuple[float, float] = (0.3, 1.3)) -> Case:
    """Return a sheet of 7 × 6 points rolled onto cylinders, turning before a pinhole camera with φ = 600 px and 640 × 480 px.

    Shapes are in camera axes, in half-widths of the sheet; `bend` holds the curvature of the first and of the last cylinder in this unit.
    """
    across, down = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-0.7, 0.7, 6)))
    curved, turn = np.linspace(*bend, frames)[:, None], np.linspace(-0.6, 0.6, frames)[:, None]
    sideways, down, forward = np.broadcast_arrays(
        np.sin(curved * across) / curved, down, (1 - np.cos(curved * across)) / curved
    )
    x, z = np.cos(turn) * sideways + np.sin(turn) * forward, np.cos(turn) * forward - np.sin(turn) * sideways
    shapes = np.stack([x, down, z + 4], axis=2)
    return Case(
        "rolled", Tracks.from_arrays([319.5, 239.5] + 600 * shapes[..., :2] / shapes[..., 2:]), None, shapes, None
    )


def read_case(folder: Path) -> Case:
    """Read `tracks.npz` (tracks, visibility) and, if present, `mesh.npz` (faces) and `truth.npz` (shapes, rotations).

    y points up unless `about.json` names pixels as the unit.
    """
    with np.load(folder / "tracks.npz") as file:
        tracks = Tracks.from_arrays(file["tracks"], file.get("visibility"))
    mesh, shapes, cameras = None, None, None
    if (folder / "mesh.npz").exists():
        with np.load(folder / "mesh.npz") as file:
            mesh = Mesh.from_faces(file["faces"], tracks.num_points)
    if (folder / "truth.npz").exists():
        with np.load(folder / "truth.npz") as file:
            shapes = file["shapes"].astype(np.float64)
            if "rotations" in file:
                cameras = KnownCamera.from_arrays(file["rotations"], np.ones(tracks.num_frames))
    about = folder / "about.json"
    pixels = about.exists() and "pixel" in json.loads(about.read_text()).get("units", "").lower()
    return Case(folder.name, tracks, mesh, shapes, cameras, y_up=not pixels)


def as_given(case: Case, visibility: str) -> Case:
    """Return a case with visibility from its file ("file"), or with all points visible, projected from the truth where possible ("all")."""
    if visibility == "file" or case.tracks.all_visible:
        return case
    if case.cameras is None or case.shapes is None:
        return case  # without truth, the positions of hidden points are unknown
    rows = case.cameras.rotations[:, :2].transpose(0, 2, 1)
    scales = np.ones(len(rows)) if case.cameras.scales is None else case.cameras.scales
    projected = scales[:, None, None] * (case.shapes @ rows)
    seen = case.tracks.visible[..., None]
    shift = ((case.tracks.points - projected) * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    return replace(case, tracks=Tracks.from_arrays(projected + shift[:, None]))


def thin(case: Case, points: int | None) -> Case:
    """Keep at most `points` points, spread evenly, and a mesh between them."""
    if points is None or case.tracks.num_points <= points:
        return case
    rest = case.tracks.points[0] if case.shapes is None else case.shapes[0]
    kept = thin_points(rest, points)
    return replace(
        case,
        tracks=Tracks.from_arrays(case.tracks.points[:, kept], case.tracks.visible[:, kept]),
        mesh=None if case.mesh is None else thin_mesh(case.mesh, rest, kept),
        shapes=None if case.shapes is None else case.shapes[:, kept],
    )

"""Read a job's files, whatever wrote them, into checked records, and say how they were understood."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.client.options import Options
from pliant.client.schemas import Interpretation
from pliant.solver import Mesh, Tracks
from pliant.worker.formats.contain import read_arrays
from pliant.worker.formats.dialects import KNOWN
from pliant.worker.formats.errors import refusal, too_large
from pliant.worker.formats.interpret import understand
from pliant.worker.formats.meshes import given_vertices, mismatch
from pliant.worker.formats.records import Arrays, GroundTruth, Inputs, Limits
from pliant.worker.formats.triangulate import triangulate
from pliant.worker.formats.truth import read_rotations, read_truth

GRID_SIZE = re.compile(r"(\d{1,6})\s*[x×X]\s*(\d{1,6})")
MESH_NAMES = ("faces", "grid", "mask", "vertices")
SELDOM = 2
"""A point seen in fewer frames than this has no motion of its own to show."""


def read_inputs(
    *,
    tracks: Path,
    mesh: Path | str | None = None,
    ground_truth: Path | None = None,
    rotations: Path | None = None,
    options: Options,
    limits: Limits = Limits(),  # noqa: B008 - frozen
) -> Inputs:
    """Read, check and interpret the files of one job.

    Parameters
    ----------
    tracks : Path
        The tracks, in any of the documented formats; recognised by content, not by name.
    mesh : Path or str, optional
        A mesh file whose vertex i is point i, a grid size `"ROWSxCOLUMNS"`, or `"none"`; left out: one is made.
    ground_truth, rotations : Path, optional
        True shapes, used for metrics alone; known cameras, used instead of estimated ones.
    options : Options
        `layout`, `rows`, `y_axis` … overrule what the data suggest.
    limits : Limits
        How much may come in.

    Raises
    ------
    InvalidInput
        With a stable code, the field, both sides and a hint.
    AmbiguousInput
        Two readings fit; the error lists them.
    """
    understood = understand(read_arrays(tracks, field="tracks", limits=limits, wanted=KNOWN), options)
    _check_size(understood.points, limits)
    checked = Tracks.from_arrays(understood.points, understood.visible)
    like = (checked.num_frames, checked.num_points)
    notes = [*understood.notes, *_hidden_notes(checked)]
    surface, source, mesh_notes = _read_mesh(mesh, checked, understood.y_axis, limits)
    truth = read_truth(ground_truth, understood, like=like, limits=limits)
    cameras = None if rotations is None else read_rotations(rotations, num_frames=like[0], limits=limits)
    interpretation = Interpretation(
        num_frames=like[0],
        num_points=like[1],
        num_faces=0 if surface is None else len(surface.faces),
        hidden_fraction=float((checked.visible == 0).mean()),
        mesh_source=source,
        mesh_grid=_whole_grid(surface),
        has_ground_truth=truth is not None,
        has_rotations=cameras is not None,
        layout=understood.layout,
        y_axis=understood.y_axis,
        notes=[*notes, *mesh_notes, *_truth_notes(ground_truth, truth)],
    )
    return Inputs(checked, surface, truth, cameras, interpretation)


def _check_size(points: NDArray[np.generic], limits: Limits) -> None:
    frames, count = points.shape[:2]
    if frames > limits.max_frames or count > limits.max_points or frames * count > limits.max_observations:
        raise too_large(
            "tracks",
            expected=f"at most {limits.max_frames} frames, {limits.max_points} points and {limits.max_observations} observations",
            got=f"{frames} frames × {count} points",
        )


def _read_mesh(
    mesh: Path | str | None, tracks: Tracks, y_axis: str, limits: Limits
) -> tuple[Mesh | None, str, list[str]]:
    if mesh is None:
        made, notes = triangulate(tracks, y_axis=y_axis)
        return made, "none" if made is None else "delaunay", notes
    if isinstance(mesh, str):
        return _mesh_by_word(mesh, tracks.num_points)
    arrays = read_arrays(mesh, field="mesh", limits=limits, wanted=frozenset(MESH_NAMES))
    given_vertices(arrays, num_points=tracks.num_points, field="mesh")
    surface = _mesh_of(arrays, tracks.num_points)
    if len(surface.faces) > limits.max_faces:
        raise too_large("mesh.faces", expected=f"at most {limits.max_faces} faces", got=f"{len(surface.faces)}")
    notes = [] if len(surface.faces) else ["The given mesh has no faces, so there is no smoothness in space."]
    return surface, "grid" if surface.grid is not None else "given", notes


def _mesh_by_word(word: str, num_points: int) -> tuple[Mesh | None, str, list[str]]:
    if word.strip().lower() == "none":
        return None, "none", ["No mesh, as asked: no smoothness in space."]
    found = GRID_SIZE.fullmatch(word.strip())
    if found is None:
        raise refusal(
            "unknown_format", "mesh", expected="a mesh file, ROWSxCOLUMNS or none", got=repr(word[:60]),
            hint="Give a file, or a grid size such as 48x64.",
        )  # fmt: skip
    rows, columns = int(found[1]), int(found[2])
    if rows * columns != num_points:
        raise mismatch("mesh", num_points, rows * columns)
    return Mesh.from_grid(np.arange(num_points).reshape(rows, columns)), "grid", []


def _mesh_of(arrays: Arrays, num_points: int) -> Mesh:
    if "faces" in arrays or "array" in arrays:
        return Mesh.from_faces(arrays.get("faces", arrays.get("array")), num_points)  # type: ignore[arg-type]
    if "mask" in arrays or "grid" in arrays:
        grid = arrays["grid"] if "grid" in arrays else number_cells(arrays["mask"])
        surface = Mesh.from_grid(grid)
        if surface.num_points != num_points:
            raise mismatch("mesh", num_points, surface.num_points)
        return surface
    raise refusal(
        "missing_array", "mesh", expected="faces, or grid", got=", ".join(sorted(arrays)) or "nothing known",
        hint="Save the faces as numpy.savez('mesh.npz', faces=faces).",
    )  # fmt: skip


def _whole_grid(surface: Mesh | None) -> tuple[int, int] | None:
    """Return rows and columns if the points fill a grid row by row, so that `"ROWSxCOLUMNS"` says the same mesh."""
    if surface is None or surface.grid is None:
        return None
    rows, columns = surface.grid.shape
    return (rows, columns) if np.array_equal(surface.grid.ravel(), np.arange(rows * columns)) else None


def number_cells(mask: NDArray[np.generic]) -> NDArray[np.int64]:
    """Give the marked cells of a picture their numbers, row by row, −1 elsewhere."""
    marked = np.asarray(mask) != 0
    return np.where(marked, np.cumsum(marked).reshape(marked.shape) - 1, -1)


def _hidden_notes(tracks: Tracks) -> list[str]:
    seen = (tracks.visible > 0).sum(axis=0)
    hidden = float((tracks.visible == 0).mean())
    notes = [f"{hidden:.1%} of the observations are hidden and carry no weight."] if hidden else []
    seldom = np.flatnonzero(seen < SELDOM)
    if len(seldom):
        shown = ", ".join(str(index) for index in seldom[:10]) + (" …" if len(seldom) > 10 else "")
        notes.append(
            f"{len(seldom)} points are seen in fewer than {SELDOM} frames (points {shown}): they keep their place in the "
            "order, and what is written for them follows from their neighbours alone."
        )
    unseen = np.flatnonzero((tracks.visible > 0).sum(axis=1) == 0)
    if len(unseen):
        notes.append(f"{len(unseen)} frames show no point at all (first: frame {unseen[0]}).")
    return notes


def _truth_notes(given: Path | None, truth: GroundTruth | None) -> list[str]:
    if truth is None or given is not None:
        return []
    return ["The tracks file holds true shapes too: they are used for metrics, and for nothing else."]

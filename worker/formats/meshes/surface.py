"""The mesh of a job: a file, a grid size, a mask of the picture, or the picture's pixel grid; vertex i is point i."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput, Mesh
from pliant.worker.formats.errors import too_large
from pliant.worker.formats.reading.containers import read_arrays
from pliant.worker.formats.reading.meshes import given_vertices, mismatch
from pliant.worker.formats.records import Arrays, Limits

GRID_SIZE = re.compile(r"(\d{1,6})\s*[x×X]\s*(\d{1,6})")
MESH_NAMES = frozenset(("faces", "grid", "mask", "vertices"))


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The connectivity of the points, as given."""

    mesh: Mesh | None
    """None: no mesh requested, or one is to be generated."""

    source: str
    """`given`, `grid`, `none`, or `delaunay` if one is to be generated."""

    notes: list[str]
    points: NDArray[np.intp] | None = None
    """The points of the mesh, if a mask selects some of a picture's; None: all."""


def read_surface(
    mesh: Path | str | None, *, num_points: int, picture: tuple[int, int] | None, limits: Limits
) -> Surface:
    """Read the form part `mesh`: a file, ROWSxCOLUMNS or `none`.

    For None, the mesh is the pixel grid if the points are the pixels of a picture; otherwise it is generated later.

    Raises
    ------
    InvalidInput
        Codes missing_array, too_large, unknown_format, vertex_count_mismatch and those of the file's reader and of `Mesh`.
    """
    if isinstance(mesh, str):
        return _by_word(mesh, num_points, limits)
    if mesh is None:
        if picture is None:
            return Surface(None, "delaunay", [])
        note = f"The points are the pixels of a picture of {picture[1]} × {picture[0]}: its grid is the mesh."
        return Surface(_grid(*picture, limits), "grid", [note])
    arrays = read_arrays(mesh, field="mesh", limits=limits, wanted=MESH_NAMES)
    if "mask" in arrays and picture is not None and arrays["mask"].shape == picture:
        marked = np.flatnonzero(arrays["mask"])
        if 0 < len(marked) < num_points:
            note = f"The mask selects {len(marked)} of the picture's {num_points} points."
            return Surface(Mesh.from_grid(number_cells(arrays["mask"])), "grid", [note], marked)
    given_vertices(arrays, num_points=num_points)
    surface = _mesh_of(arrays, num_points)
    _check_faces(len(surface.faces), limits)
    notes = [] if len(surface.faces) else ["The given mesh has no faces, so there is no smoothness in space."]
    return Surface(surface, "grid" if surface.grid is not None else "given", notes)


def _by_word(word: str, num_points: int, limits: Limits) -> Surface:
    if word.strip().lower() == "none":
        return Surface(None, "none", ["No mesh was requested: no smoothness in space."])
    found = GRID_SIZE.fullmatch(word.strip())
    if found is None:
        raise InvalidInput(
            "unknown_format", field="mesh", expected="a mesh file, ROWSxCOLUMNS or none", got=repr(word[:60]),
            hint="Give a file, or a grid size such as 48x64.",
        )  # fmt: skip
    rows, columns = int(found[1]), int(found[2])
    if rows * columns != num_points:
        raise mismatch(num_points, rows * columns)
    return Surface(_grid(rows, columns, limits), "grid", [])


def _grid(rows: int, columns: int, limits: Limits) -> Mesh:
    _check_faces((rows - 1) * (columns - 1), limits)
    return Mesh.from_grid(np.arange(rows * columns).reshape(rows, columns))


def _check_faces(count: int, limits: Limits) -> None:
    if count > limits.max_faces:
        raise too_large("mesh.faces", expected=f"at most {limits.max_faces:,} faces", got=f"{count:,}")


def _mesh_of(arrays: Arrays, num_points: int) -> Mesh:
    if "faces" in arrays or "array" in arrays:
        return Mesh.from_faces(arrays.get("faces", arrays.get("array")), num_points)  # type: ignore[arg-type]
    if "mask" in arrays or "grid" in arrays:
        if "grid" not in arrays and np.count_nonzero(arrays["mask"]) != num_points:
            raise mismatch(num_points, int(np.count_nonzero(arrays["mask"])))
        grid = arrays["grid"] if "grid" in arrays else number_cells(arrays["mask"])
        surface = Mesh.from_grid(grid)
        if surface.num_points != num_points:
            raise mismatch(num_points, surface.num_points)
        return surface
    raise InvalidInput(
        "missing_array", field="mesh", expected="faces, or grid", got=", ".join(sorted(arrays)) or "no array of a known name",
        hint="Save the faces as numpy.savez('mesh.npz', faces=faces).",
    )  # fmt: skip


def whole_grid(surface: Surface) -> tuple[int, int] | None:
    """Return rows and columns if the mesh equals that of `"ROWSxCOLUMNS"`, with all points row by row; else None."""
    if surface.mesh is None or surface.mesh.grid is None or surface.points is not None:
        return None
    rows, columns = surface.mesh.grid.shape
    return (rows, columns) if np.array_equal(surface.mesh.grid.ravel(), np.arange(rows * columns)) else None


def number_cells(mask: NDArray[np.generic]) -> NDArray[np.int64]:
    """Return the numbers of the marked cells of a picture, row by row; −1 elsewhere."""
    marked = np.asarray(mask) != 0
    return np.where(marked, np.cumsum(marked).reshape(marked.shape) - 1, -1)

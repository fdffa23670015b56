"""The mesh of a job: a file, a grid size, a mask of the picture, or the picture's pixel grid; vertex i is point i."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput, Mesh
from pliant.worker.formats.errors import missing_array, too_large
from pliant.worker.formats.reading.containers import read_arrays, shapes_in
from pliant.worker.formats.reading.meshes import given_vertices, mismatch
from pliant.worker.formats.records import Arrays, Limits

GRID_SIZE = re.compile(r"(\d{1,6})\s*[x×X]\s*(\d{1,6})")
COMPARED_FRAMES = 8
"""Number of frames in which the two orders of a grid's size are compared."""

TRANSPOSED = 1.5
"""Ratio of mean edge lengths, as given to exchanged, above which rows and columns are exchanged. Measured on grids of 2 to 40 rows and
columns: exchanged ones with square cells 1.58 and more; right ones, with cells of any shape, 1.05 and less; points in random order up to
1.4."""

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
    surface = _mesh_of(arrays, num_points, mesh)
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


def _mesh_of(arrays: Arrays, num_points: int, file: Path) -> Mesh:
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
    raise missing_array(
        "mesh", expected="faces, or grid", there=shapes_in(file, arrays),
        hint="Save the faces as numpy.savez('mesh.npz', faces=faces).",
    )  # fmt: skip


def check_order(surface: Surface, points: NDArray[np.generic], visible: NDArray[np.float64] | None) -> None:
    """Reject a grid whose rows and columns are exchanged; `points` has shape `(F, P, 2)`.

    Raises
    ------
    InvalidInput
        Code transposed_grid.
    """
    size = whole_grid(surface)
    if size is None or size[0] == size[1]:
        return
    some = slice(None, None, -(-len(points) // COMPARED_FRAMES))
    seen = np.isfinite(points[some]).all(axis=2)
    if visible is not None:
        seen &= visible[some] > 0
    given, exchanged = (_mean_edge(points[some], seen, shape) for shape in (size, size[::-1]))
    if given > TRANSPOSED * exchanged:
        rows, columns = size
        raise InvalidInput(
            "transposed_grid", field="mesh", expected="ROWSxCOLUMNS, with neighbours close together in the picture",
            got=f"{rows}x{columns}, whose edges are {given / exchanged:.1f} times as long as those of {columns}x{rows}",
            hint=f"Give mesh {columns}x{rows}.",
        )  # fmt: skip


def _mean_edge(points: NDArray[np.generic], seen: NDArray[np.bool_], shape: tuple[int, int]) -> float:
    """Return the mean length of the edges of a grid of this shape whose ends are seen; 0 if there are none."""
    grid, known = points.reshape(len(points), *shape, 2), seen.reshape(len(points), *shape)
    total, count = 0.0, 0
    for near, far in ((np.s_[:, :, :-1], np.s_[:, :, 1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        both = known[near] & known[far]
        steps = grid[far][both].astype(np.float64) - grid[near][both].astype(np.float64)
        total, count = total + float(np.hypot(steps[:, 0], steps[:, 1]).sum()), count + len(steps)
    return total / max(count, 1)


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

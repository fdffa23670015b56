"""The faces that connect the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pliant.solver.errors import numeric, shape_text, wrong_input
from pliant.solver.records import Ints, read_only


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Mesh:
    """Faces that connect the points. Vertex i is point i; the order is never changed."""

    num_points: int
    """P."""

    faces: Ints
    """Triangles `(T, 3)` or quads `(T, 4)`, counter-clockwise, indices into the points; T may be 0."""

    grid: Ints | None = None
    """Point index of every cell of a pixel grid, −1 for holes, shape `(rows, columns)`; None without a grid."""

    def __repr__(self) -> str:
        return f"<Mesh of {self.num_points} points, faces of shape {np.shape(self.faces)}>"

    @classmethod
    def from_faces(cls, faces: ArrayLike, num_points: int) -> Mesh:
        """Validate and copy faces.

        Raises
        ------
        InvalidInput
            Not an integer array of 3 or 4 columns, an index out of range, or a face that repeats a vertex.
        """
        hint = "Convert the faces to int32."
        given = numeric(faces, "mesh.faces", hint)
        if given.size == 0:
            given = np.zeros((0, 3), dtype=np.int32)
        if given.dtype.kind == "f":
            raise wrong_input("mesh.faces", "wrong_type", "integers", f"dtype {given.dtype}", hint)
        if given.ndim != 2 or given.shape[1] not in (3, 4):
            raise wrong_input(
                "mesh.faces", "wrong_shape", "(faces, 3) or (faces, 4)", shape_text(given),
                "Give triangles or quads; split larger polygons first.",
            )  # fmt: skip
        if len(given) > 0 and (int(given.min()) < 0 or int(given.max()) >= num_points):
            raise wrong_input(
                "mesh.faces", "index_out_of_range", f"indices from 0 to {num_points - 1} (the tracks have {num_points} points)",
                f"indices from {given.min()} to {given.max()}", "Vertex i of the mesh must be point i of the tracks; indices start at 0.",
            )  # fmt: skip
        ordered = np.sort(given, axis=1)
        if bool((ordered[:, 1:] == ordered[:, :-1]).any()):
            bad = int(np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))[0])
            raise wrong_input(
                "mesh.faces", "degenerate_face", "distinct vertices in every face", f"face {bad} = {given[bad].tolist()}",
                "Remove faces that repeat a vertex.",
            )  # fmt: skip
        kept = np.array(given, dtype=np.int32)
        read_only(kept)
        return cls(num_points, kept)

    @classmethod
    def from_grid(cls, grid: ArrayLike) -> Mesh:
        """Return the mesh of quads between the cells of a pixel grid, which may have holes.

        Parameters
        ----------
        grid : array_like of int, shape (rows, columns)
            Point index of each cell, −1 for holes; every point appears exactly once.

        Raises
        ------
        InvalidInput
            Not a two-dimensional integer array, or an index from 0 to P−1 is missing or repeated.
        """
        given = numeric(grid, "mesh.grid", "Give the point index of every cell, −1 for holes.")
        if given.dtype.kind == "f" or given.ndim != 2:
            raise wrong_input(
                "mesh.grid", "wrong_shape", "an integer array (rows, columns)", f"{given.dtype} {shape_text(given)}",
                "Give the point index of every cell, −1 for holes.",
            )  # fmt: skip
        present = given[given != -1]
        if present.size == 0 or not np.array_equal(np.sort(present), np.arange(present.size)):
            raise wrong_input(
                "mesh.grid", "index_out_of_range", f"each index from 0 to {max(present.size - 1, 0)} exactly once",
                "missing or repeated indices", "Number the grid's points without gaps; −1 marks a hole.",
            )  # fmt: skip
        cells = np.array(given, dtype=np.int32)
        corners = np.stack([cells[:-1, :-1], cells[1:, :-1], cells[1:, 1:], cells[:-1, 1:]], axis=-1).reshape(-1, 4)
        faces = np.ascontiguousarray(corners[(corners >= 0).all(axis=1)])
        read_only(cells)
        read_only(faces)
        return cls(int(present.size), faces, cells)

    @property
    def edges(self) -> Ints:
        """Undirected edges of the faces, each once with the lower index first, shape `(E, 2)`."""
        if len(self.faces) == 0:
            return np.zeros((0, 2), dtype=np.int32)
        following = np.roll(self.faces, -1, axis=1)
        low, high = np.minimum(self.faces, following), np.maximum(self.faces, following)
        keys = (low.astype(np.int64) * self.num_points + high).ravel()
        keys.sort()  # for a million edges 20 times as fast as `np.unique`, which hashes them
        keys = keys[np.append(True, keys[1:] != keys[:-1])]
        return np.stack([keys // self.num_points, keys % self.num_points], axis=1).astype(self.faces.dtype)


def triangles_of(faces: Ints) -> Ints:
    """Split quads `(T, 4)` along the diagonal of their corners 0 and 2, into triangles `(2T, 3)`; triangles stay as they are."""
    if faces.shape[1] == 3:
        return faces
    return np.stack([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]], axis=1).reshape(-1, 3)

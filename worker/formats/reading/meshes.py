"""Meshes from OBJ and PLY. Vertex order is the file's: nothing is merged, split, sorted or cleaned.

General loaders split vertices at texture seams and merge equal ones, which destroys the correspondence of vertex i with point i. OBJ is
therefore parsed here, `v` and `f` only, and PLY by plyfile, which keeps rows as they are.
"""

from __future__ import annotations

import codecs
import io
import re
from typing import IO

import numpy as np
import plyfile
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged, too_large
from pliant.worker.formats.records import Arrays, Limits

MAX_LINE = 4096
PLY_ELEMENT = re.compile(rb"^element[ \t]+(\S{1,64})[ \t]+(\S{1,20})", re.MULTILINE)
NOT_A_MESH = "Give an OBJ, PLY, glTF or npz mesh, a grid size such as 48x64, or leave the mesh out."


def read_obj(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read `vertices (V, 3)` and zero-based `faces (T, 3)` or `(T, 4)` of a Wavefront OBJ; keywords other than `v` and `f` are ignored.

    Raises
    ------
    InvalidInput
        Codes damaged_file, degenerate_face, index_out_of_range, unknown_format, too_large, wrong_shape.
    """
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    number, begun = 0, b""
    while line := stream.readline(MAX_LINE + 1):
        number += 1
        line = begun + (line.removeprefix(codecs.BOM_UTF8) if number == 1 else line)
        if len(line) > MAX_LINE or b"\0" in line:
            raise damaged(field, f"line {number}, which is longer than {MAX_LINE:,} bytes or not text")
        line = line.partition(b"#")[0].rstrip()  # before the continuation: a comment may end in a Windows path
        begun = line[:-1] + b" " if line.endswith(b"\\") else b""
        words = [] if begun else line.split()
        if not words:
            continue
        try:
            if words[0] == b"v":
                vertices.append([float(word) for word in words[1:4]])
            elif words[0] == b"f":
                polygons.append([_obj_index(word, len(vertices)) for word in words[1:]])
        except ValueError as error:
            raise damaged(field, f"line {number}, which is not a vertex or face") from error
        if len(vertices) > limits.max_points or len(polygons) > limits.max_faces:
            raise too_large(
                field, expected=f"at most {limits.max_points:,} vertices and {limits.max_faces:,} faces", got="more"
            )
    if begun:
        raise damaged(field, "a last line that is continued on none")
    if not vertices:
        raise InvalidInput(
            "unknown_format", field=field, expected="a mesh file", got="text without vertices", hint=NOT_A_MESH
        )
    if any(len(vertex) != 3 for vertex in vertices):
        raise damaged(field, "a vertex without three coordinates")
    faces = join_polygons(polygons, field=field)
    _check_obj_faces(faces, len(vertices), field)
    return {"vertices": np.array(vertices, dtype=np.float64), "faces": faces}


def _check_obj_faces(faces: NDArray[np.int64], count: int, field: str) -> None:
    """Check the indices as `Mesh` does, but state them as the file does, from 1."""
    if faces.size and not (faces.min() >= 0 and faces.max() < count):
        raise InvalidInput(
            "index_out_of_range", field=f"{field}.faces", expected=f"indices from 1 to {count}, the vertices of the OBJ",
            got=f"indices from {faces.min() + 1} to {faces.max() + 1}", hint="The first vertex of an OBJ has index 1.",
        )  # fmt: skip
    ordered = np.sort(faces, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(repeated):
        raise InvalidInput(
            "degenerate_face", field=f"{field}.faces", expected="distinct vertices in every face",
            got="f " + " ".join(str(index + 1) for index in faces[repeated[0]]), hint="Remove faces that repeat a vertex.",
        )  # fmt: skip


def read_ply(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read vertices and faces of a PLY, ascii or binary of either byte order.

    Raises
    ------
    InvalidInput
        Codes damaged_file, too_large, wrong_shape.
    """
    head = stream.read(1 << 16).partition(b"end_header")[0]
    stream.seek(0)
    allowed = {b"vertex": limits.max_points, b"face": limits.max_faces}
    for name, count in PLY_ELEMENT.findall(head):
        if not count.isdigit() or int(count) > allowed.get(name, limits.max_faces):
            raise too_large(
                field, expected=f"at most {limits.max_points:,} vertices and {limits.max_faces:,} faces",
                got=f"{count.decode('latin-1')} of {name.decode('latin-1')}",
            )  # fmt: skip
    try:
        content = plyfile.PlyData.read(io.BytesIO(stream.read()), mmap=False)
        names = {element.name for element in content.elements}
        vertices = np.column_stack([np.asarray(content["vertex"][axis], dtype=np.float64) for axis in "xyz"])
        polygons = _ply_polygons(content["face"]) if "face" in names else []
    except (plyfile.PlyParseError, ValueError, KeyError, TypeError, IndexError, EOFError, OverflowError) as error:
        reason = f"no element {error}" if isinstance(error, KeyError) else str(error)[:120]
        raise damaged(field, f"a PLY file that cannot be read ({reason})") from error
    return {"vertices": vertices, "faces": join_polygons(polygons, field=field)}


def join_polygons(polygons: list[list[int]], *, field: str) -> NDArray[np.int64]:
    """Return one array of faces: quads stay quads if all are; otherwise polygons become fans of triangles."""
    sizes = {len(polygon) for polygon in polygons}
    if sizes and min(sizes) < 3:
        raise InvalidInput(
            "wrong_shape", field=f"{field}.faces", expected="faces of three vertices or more", got=f"a face of {min(sizes)}",
            hint="Remove points and lines from the faces.",
        )  # fmt: skip
    if sizes not in ({3}, {4}):
        polygons = [[face[0], face[i], face[i + 1]] for face in polygons for i in range(1, len(face) - 1)]
    try:
        return np.array(polygons, dtype=np.int64).reshape(-1, 4 if sizes == {4} else 3)
    except OverflowError as error:
        raise damaged(f"{field}.faces", "an index beyond 64 bits") from error


def given_vertices(arrays: Arrays, *, num_points: int) -> None:
    """Check that the mesh has a vertex for each point.

    Raises
    ------
    InvalidInput
        Code vertex_count_mismatch.
    """
    if "vertices" in arrays:
        count = arrays["vertices"].shape[0] if arrays["vertices"].ndim else 0
        if count != num_points:
            raise mismatch(num_points, count)


def mismatch(num_points: int, num_vertices: int) -> InvalidInput:
    """Return the error for a mesh that does not match the tracks."""
    return InvalidInput(
        "vertex_count_mismatch", field="mesh", expected=f"{num_points} vertices, one for each point of the tracks", got=f"{num_vertices}",
        hint="Vertex i of the mesh must be point i of the tracks, in the same order; omit the mesh to have one generated.",
    )  # fmt: skip


def _obj_index(word: bytes, so_far: int) -> int:
    """Return a zero-based index: `7`, `7/1` and `7//3` count from 1, negative numbers back from the latest vertex."""
    index = int(word.split(b"/", 1)[0])
    return index - 1 if index > 0 else so_far + index if index < 0 else -1


def _ply_polygons(element: plyfile.PlyElement) -> list[list[int]]:
    lists = [item.name for item in element.properties if isinstance(item, plyfile.PlyListProperty)]
    name = next((name for name in ("vertex_indices", "vertex_index") if name in lists), None)
    if name is None:
        raise ValueError("faces without vertex_indices")
    return [[int(index) for index in polygon] for polygon in element[name]]

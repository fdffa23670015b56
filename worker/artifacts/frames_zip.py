"""A zip with one PLY or OBJ file per frame, as read by motion capture programs."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from typing import IO

import numpy as np
from numpy.typing import NDArray
from pliant.solver.mesh import triangles_of
from pliant.worker.artifacts.geometry import Floats, vertex_normals
from pliant.worker.artifacts.names import header_line, word
from pliant.worker.artifacts.result import Result

FIRST_DAY = (1980, 1, 1, 0, 0, 0)

MATERIAL_HEAD = "mtllib shapes.mtl\nusemtl film\n"
MATERIAL = "newmtl film\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd texture.jpg\n"

OnProgress = Callable[[float], None]


def write_ply_zip(result: Result, file: IO[bytes], on_progress: OnProgress) -> None:
    """Write a binary little-endian PLY for every frame, `frame_00000.ply` …; single precision, in the tracks' unit."""
    faces = result.faces
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("index", "<i4", (faces.shape[1],))])
    rows["count"], rows["index"] = faces.shape[1], faces
    tail = rows.tobytes()

    def content(frame: int) -> bytes:
        points, normals, colours = _frame(result, frame)
        fields = [("float", name, column) for name, column in zip("xyz", points.T, strict=True)]
        if normals is not None:
            fields += [("float", name, column) for name, column in zip(("nx", "ny", "nz"), normals.T, strict=True)]
        if colours is not None:
            bright = np.rint(colours * 255)
            fields += [("uchar", name, column) for name, column in zip(("red", "green", "blue"), bright.T, strict=True)]
        types = {"float": "<f4", "uchar": "u1"}
        table = np.zeros(len(points), dtype=[(name, types[kind]) for kind, name, _ in fields])
        for _, name, column in fields:
            table[name] = column
        head = [
            "ply", "format binary_little_endian 1.0", f"comment name: {header_line(result.name)}",
            *(f"comment {line}" for line in _header_lines(result)),
            f"element vertex {len(points)}", *(f"property {kind} {name}" for kind, name, _ in fields),
            f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n",
        ]  # fmt: skip
        return "\n".join(head).encode() + table.tobytes() + tail

    _write_members(file, content, len(result.solution.shapes), "ply", on_progress)


def write_obj_zip(result: Result, file: IO[bytes], on_progress: OnProgress) -> None:
    """Write a Wavefront OBJ for every frame, `frame_00000.obj` …; nine digits, which is single precision, in the tracks' unit.

    Colours follow the coordinates, as MeshLab, Blender and Open3D expect. With a texture, the archive also contains `shapes.mtl` and
    `texture.jpg`; v of `vt` points up.
    """
    texture = result.texture
    head = "".join(f"# {line}\n" for line in _header_lines(result)) + (MATERIAL_HEAD if texture is not None else "")
    head += f"o {word(result.name)}\n"
    places = "" if texture is None else _lines("vt", texture.uv_up, "%.6f")
    corner = _corner(textured=texture is not None, moving=result.moving_normals)
    tail = "".join("f " + " ".join(corner.format(index + 1) for index in face) + "\n" for face in result.faces.tolist())
    if len(result.faces) == 0:
        tail = "".join(f"p {index + 1}\n" for index in range(result.solution.shapes.shape[1]))

    def content(frame: int) -> bytes:
        points, normals, colours = _frame(result, frame)
        if texture is not None:
            colours = None
        vertices = _lines("v", points, "%.9g") if colours is None else _lines("v", np.hstack([points, colours]), "%.9g")
        return (head + vertices + places + ("" if normals is None else _lines("vn", normals, "%.6g")) + tail).encode()

    beside = {} if texture is None else {"shapes.mtl": MATERIAL.encode(), "texture.jpg": texture.jpeg}
    _write_members(file, content, len(result.solution.shapes), "obj", on_progress, beside=beside)


def _corner(*, textured: bool, moving: bool) -> str:
    """Return how a face refers to vertex, texture coordinate and normal of the same index."""
    if textured:
        return "{0}/{0}/{0}" if moving else "{0}/{0}"
    return "{0}//{0}" if moving else "{0}"


def _frame(result: Result, frame: int) -> tuple[Floats, Floats | None, Floats | None]:
    """Return points, normals and sRGB colours `(P, 3)` of one frame; None for those not requested."""
    shape = result.standing(frame) if result.options.axes == "viewer" else result.solution.shapes[frame]
    points = shape.astype(np.float32).astype(np.float64)
    normals = None
    if result.moving_normals:
        normals = vertex_normals(points, triangles_of(result.faces)).astype(np.float64)
    return points, normals, result.picture_colours if result.painting is None else result.painting.frame(frame)


def _header_lines(result: Result) -> list[str]:
    y_axis = "up" if result.options.axes == "viewer" else result.y_axis
    if np.allclose(result.solution.camera.rotations[0], np.eye(3)):
        axes = f"x right, y {y_axis}, z {'away from' if y_axis == 'down' else 'towards'} the first camera"
    else:
        axes = "world axes of the cameras" + ("" if y_axis == result.y_axis else ", y and z reversed")
    lines = [f"{axes}; unit of the tracks"]
    if result.painting is not None:
        painting = result.painting
        lines.append(
            f"colour: {painting.quantity}, dark at 0, bright at {painting.top:.6g} ({painting.unit}) and above"
        )
    elif result.picture_colours is not None:
        lines.append("colour: the film's template frame")
    return lines


def _lines(word: str, rows: Floats | NDArray[np.float32], number: str) -> str:
    """Return rows `(N, width)` as lines that start with a keyword."""
    line = " ".join([word] + [number] * rows.shape[1]) + "\n"
    return (line * len(rows)) % tuple(rows.ravel().tolist())


def _write_members(
    file: IO[bytes], content: Callable[[int], bytes], count: int, suffix: str, on_progress: OnProgress,
    *, beside: Mapping[str, bytes] | None = None,
) -> None:  # fmt: skip
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, whole in (beside or {}).items():
            archive.writestr(zipfile.ZipInfo(name, FIRST_DAY), whole, zipfile.ZIP_STORED)
        for index in range(count):
            # A fixed date, so that equal results give identical files.
            archive.writestr(
                zipfile.ZipInfo(f"frame_{index:05d}.{suffix}", FIRST_DAY), content(index), zipfile.ZIP_DEFLATED, 1
            )
            on_progress((index + 1) / count)

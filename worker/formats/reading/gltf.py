"""A static mesh from glTF 2.0, binary or JSON with embedded data: vertices and indices of one primitive, in the file's order.

Morph targets, skins, textures and node transforms are ignored: a job only needs to know which points are neighbours.
"""

from __future__ import annotations

import base64
import json
import struct
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pliant.solver import InvalidInput
from pliant.worker.formats.errors import damaged, too_large
from pliant.worker.formats.records import Arrays, Limits

MAX_JSON = 64 << 20
TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3}
TRIANGLES = 4


def read_glb(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read a binary glTF.

    Raises
    ------
    InvalidInput
        Codes damaged_file, too_large, unsupported_feature.
    """
    head = stream.read(20)
    if len(head) < 20:
        raise damaged(field, "a GLB that is cut off")
    _, version, _, length, kind = struct.unpack("<4sIII4s", head)
    if version != 2 or kind != b"JSON" or length > MAX_JSON:
        raise damaged(field, f"a GLB of version {version} whose first part is {kind!r} of {length} bytes")
    text = stream.read(length)
    start = stream.read(8)
    binary = stream.read() if start[4:8] == b"BIN\0" else b""
    return _mesh(text, binary, field, limits)


def read_gltf(stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Read a glTF in JSON whose buffer is embedded as base64; external files are rejected.

    Raises
    ------
    InvalidInput
        Codes damaged_file, too_large, unsupported_feature.
    """
    return _mesh(stream.read(limits.max_bytes), b"", field, limits)


def _mesh(text: bytes, binary: bytes, field: str, limits: Limits) -> Arrays:
    try:
        document = json.loads(text)
        primitives = [primitive for mesh in document["meshes"] for primitive in mesh["primitives"]]
        if len(primitives) != 1 or primitives[0].get("mode", TRIANGLES) != TRIANGLES:
            raise InvalidInput(
                "unsupported_feature", field=field, expected="one mesh of triangles with one material", got=f"{len(primitives)} parts",
                hint="Join the parts, or export OBJ or PLY, keeping the vertex order.",
            )  # fmt: skip
        vertices = _accessor(document, binary, primitives[0]["attributes"]["POSITION"], field, limits)
        if "indices" in primitives[0]:
            indices = _accessor(document, binary, primitives[0]["indices"], field, limits).reshape(-1)
        else:
            indices = np.arange(len(vertices), dtype=np.int64)
        faces = indices[: len(indices) // 3 * 3].astype(np.int64).reshape(-1, 3)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)[:100]
        raise damaged(field, f"a glTF that cannot be read ({reason})") from error
    if len(faces) > limits.max_faces or len(vertices) > limits.max_points:
        raise too_large(
            field, expected=f"at most {limits.max_points:,} vertices and {limits.max_faces:,} faces", got="more"
        )
    return {"vertices": vertices.astype(np.float64), "faces": faces}


def _accessor(document: dict[str, Any], binary: bytes, index: int, field: str, limits: Limits) -> NDArray[np.generic]:
    described = document["accessors"][index]
    view = document["bufferViews"][described["bufferView"]] if "bufferView" in described else None
    if "sparse" in described or view is None or "extensions" in view:  # extensions compress the data
        raise InvalidInput(
            "unsupported_feature", field=field, expected="plain accessors", got="sparse or compressed data",
            hint="Export without compression, or as OBJ or PLY.",
        )  # fmt: skip
    dtype, width, count = (
        np.dtype(TYPES[described["componentType"]]),
        WIDTHS[described["type"]],
        _whole(described["count"]),
    )
    size = dtype.itemsize * width
    stride = _whole(view.get("byteStride", size))
    start = _whole(view.get("byteOffset", 0)) + _whole(described.get("byteOffset", 0))
    if not (0 < count <= 3 * limits.max_faces and size <= stride <= 252 + size and start >= 0):
        raise too_large(field, expected="counts within the limits", got=f"{count:,} rows of {stride} bytes")
    raw = np.frombuffer(_buffer(document, binary, _whole(view["buffer"]), field), np.uint8)
    if start + (count - 1) * stride + size > len(raw):
        raise ValueError("an accessor beyond its buffer")
    rows = np.lib.stride_tricks.as_strided(raw[start:], (count, size), (stride, 1), writeable=False)
    return np.ascontiguousarray(rows).view(dtype)


def _whole(value: object) -> int:
    if type(value) is not int:
        raise ValueError(f"{str(value)[:20]!r} is not a whole number")
    return value


def _buffer(document: dict[str, Any], binary: bytes, index: int, field: str) -> bytes:
    uri = document["buffers"][index].get("uri")
    if uri is None:
        return binary
    kind, _, encoded = str(uri).partition(";base64,")
    if not kind.startswith("data:") or not encoded:
        raise InvalidInput(
            "unsupported_feature", field=field, expected="data inside the file itself", got="a buffer in another file",
            hint="Export a binary glTF (.glb), or one with embedded data.",
        )  # fmt: skip
    return base64.b64decode(encoded, validate=True)

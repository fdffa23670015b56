"""Building blocks of crafted files: archives, HDF5, MAT, PLY, glTF and PNG that are not what they claim to be."""

from __future__ import annotations

import base64
import io
import json
import struct
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io

CANARY = Path(tempfile.gettempdir()) / "pliant-canary-of-the-attack-tests"
"""The file that exists if code in a crafted file was run."""

SECRET = "/etc/passwd"


class Runs:
    """Unpickling this creates the canary."""

    def __reduce__(self) -> tuple[object, ...]:
        return (open, (str(CANARY), "w"))


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def header(text: str, data: bytes = b"", *, length: int | None = None) -> bytes:
    """A .npy whose header is this text."""
    raw = text.encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(raw) if length is None else length) + raw + data


def described(shape: str, descr: str = "'<f8'") -> str:
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n"


HONEST = npy(np.cumsum(np.random.default_rng(0).normal(size=(6, 20, 2)), axis=0) + 100)


def archive(*members: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", method) as file:
        warnings.simplefilter("ignore")
        for name, content in members:
            file.writestr(zipfile.ZipInfo(name), content, method)
    return buffer.getvalue()


def deflated(start: bytes, megabytes: int, *, window: int = 15) -> bytes:
    """Return a zlib stream (raw deflate with a window of −15) of `start` and so many megabytes of zeros after it.

    Only one megabyte is compressed: flushed before and after, its block is the same whatever precedes it.
    """
    packer, zero = zlib.compressobj(9, zlib.DEFLATED, window), bytes(1 << 20)
    head = packer.compress(start) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(zero) + packer.flush(zlib.Z_FULL_FLUSH)
    last = packer.flush()
    if window > 0:
        check = zlib.adler32(start)
        for _ in range(megabytes):
            check = zlib.adler32(zero, check)
        last = last[:-4] + struct.pack(">I", check)
    return head + megabytes * block + last


def zeros(megabytes: int, shape: str) -> bytes:
    """Return an npz of a header and this many megabytes of zeros, a thousandth of that on disk."""
    start, zero = header(described(shape)), bytes(1 << 20)
    check, name = zlib.crc32(start), b"tracks.npy"
    for _ in range(megabytes):
        check = zlib.crc32(zero, check)
    content = deflated(start, megabytes, window=-15)
    sizes = struct.pack("<3H4x3I2H", 20, 0, 8, check, len(content), len(start) + (megabytes << 20), len(name), 0)
    local = b"PK\x03\x04" + sizes + name + content
    entry = b"PK\x01\x02" + struct.pack("<H", 20) + sizes + bytes(14) + name
    return local + entry + b"PK\x05\x06" + struct.pack("<4H2IH", 0, 0, 1, 1, len(entry), len(local), 0)


def patched(content: bytes, old: bytes, new: bytes, *, count: int = -1) -> bytes:
    assert old in content
    return content.replace(old, new, count)


def declared_smaller() -> bytes:
    """Return an archive with a member of 4 MB whose directory entry claims 1 kB."""
    whole = archive(("tracks.npy", header(described("(64, 4096, 2)")) + bytes(64 * 4096 * 16)))
    size = struct.pack("<L", len(header(described("(64, 4096, 2)"))) + 64 * 4096 * 16)
    return patched(whole, size, struct.pack("<L", 1024))


def overlapping() -> bytes:
    """Return an archive of one compressed member that sixty directory entries share."""
    whole = bytearray(archive(("tracks.npy", HONEST)))
    start = whole.find(b"PK\x01\x02")
    end = whole.find(b"PK\x05\x06")
    entry = bytes(whole[start:end])
    entries = b"".join(
        patched(entry, b"tracks.npy", f"track{index:02d}py"[:6].encode() + b".npy") for index in range(60)
    )
    tail = bytearray(whole[end:])
    tail[8:12] = struct.pack("<HH", 60, 60)
    tail[12:16] = struct.pack("<L", len(entries))
    return bytes(whole[:start]) + entries + bytes(tail)


def many_members() -> bytes:
    return archive(*((f"a{index}.npy", b"") for index in range(1000)), method=zipfile.ZIP_STORED)


def encrypted() -> bytes:
    whole = bytearray(archive(("tracks.npy", HONEST)))
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        whole[whole.find(mark) + at] |= 1
    return bytes(whole)


def hdf5(build: Callable[[h5py.File], object], **more: object) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.mat"
        with h5py.File(path, "w", **more) as file:
            build(file)
        return path.read_bytes()


def hdf5_external(file: h5py.File) -> None:
    file.create_dataset("W", (20, 20), dtype="u1", external=[(SECRET, 0, 400)])


def hdf5_virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((20, 20), "f8")
    layout[:] = h5py.VirtualSource("/tmp/other.h5", "W", shape=(20, 20))
    file.create_virtual_dataset("W", layout)


def hdf5_circle(file: h5py.File) -> None:
    inner = file.create_group("a/b")
    inner["c"] = file["a"]


def hdf5_deep(file: h5py.File) -> None:
    group: h5py.Group = file
    for _ in range(200):
        group = group.create_group("g")
    group["W"] = np.ones((20, 20))


def hdf5_cells(file: h5py.File) -> None:
    file["a"] = np.ones((2, 30))
    cells = file.create_dataset("W", (1, 25_000), dtype=h5py.ref_dtype)
    cells[...] = file["a"].ref


def hdf5_bomb(file: h5py.File) -> None:
    file.create_dataset("W", (2000, 50_000), dtype="f8", chunks=(2000, 1000), compression="gzip")  # none of it written


def mat(*, packed: bool = False, format: str = "5", **variables: object) -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables, do_compression=packed, format=format)
    return buffer.getvalue()


MAT_HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def mat_element(kind: int, content: bytes, *, size: int | None = None) -> bytes:
    return struct.pack("<II", kind, len(content) if size is None else size) + content + b"\0" * (-len(content) % 8)


def mat_matrix(dims: tuple[int, ...], *, size: int | None = None, data: bytes = bytes(64), flags: int = 6) -> bytes:
    """Return one variable W of doubles, with arbitrary dimensions and sizes."""
    inside = mat_element(6, struct.pack("<II", flags, 0)) + mat_element(5, struct.pack(f"<{len(dims)}i", *dims))
    inside += mat_element(1, b"W") + mat_element(9, data, size=size)
    return MAT_HEADER + mat_element(14, inside)


def mat_nested(depth: int) -> bytes:
    """A cell in a cell in a cell …"""
    content = b""
    for _ in range(depth):
        inside = (
            mat_element(6, struct.pack("<II", 1, 0))
            + mat_element(5, struct.pack("<2i", 1, 1))
            + mat_element(1, b"W")
            + content
        )
        content = mat_element(14, inside)
    return MAT_HEADER + content


def mat_packed_bomb() -> bytes:
    """Return a compressed variable that inflates to 268 MB, whatever its dimensions are."""
    inside = (
        mat_element(6, struct.pack("<II", 6, 0)) + mat_element(5, struct.pack("<2i", 10, 10)) + mat_element(1, b"W")
    )
    content = deflated(struct.pack("<II", 14, 1 << 28) + inside + struct.pack("<II", 9, 1 << 28), 1 << 8)
    return MAT_HEADER + struct.pack("<II", 15, len(content)) + content


def ply(head: str, body: bytes = b"", *, kind: str = "binary_little_endian") -> bytes:
    return f"ply\nformat {kind} 1.0\n{head}end_header\n".encode() + body


def mat_many_bombs() -> bytes:
    whole = mat(W=np.zeros((980, 980)), packed=True)
    return whole[:128] + 10 * whole[128:]


PLY_VERTEX = "element vertex 20\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACE = "element face 1\nproperty list uint int vertex_indices\n"
OBJ_POINTS = "".join(f"v {index} 0 {index % 3}\n" for index in range(20))


def glb(document: object, binary: bytes = b"", *, length: int | None = None) -> bytes:
    text = json.dumps(document).encode() if not isinstance(document, bytes) else document
    text += b" " * (-len(text) % 4)
    body = (
        struct.pack("<I4s", len(text) if length is None else length, b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def gltf(**changed: object) -> dict[str, object]:
    """Return a document of 20 vertices and 2 triangles, with some parts replaced."""
    document: dict[str, object] = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": 264}],
        "bufferViews": [{"buffer": 0, "byteLength": 240}, {"buffer": 0, "byteOffset": 240, "byteLength": 24}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 20, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 6, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    }  # fmt: skip
    return {**document, **changed}


def accessors(**first: object) -> list[dict[str, object]]:
    return [
        {"bufferView": 0, "componentType": 5126, "count": 20, "type": "VEC3", **first},
        {"bufferView": 1, "componentType": 5125, "count": 6, "type": "SCALAR"},
    ]


BINARY = np.zeros((20, 3), "<f4").tobytes() + np.array([0, 1, 2, 3, 4, 5], "<u4").tobytes()


GFACES = base64.b64encode(BINARY).decode()


def png(width: int, height: int, *chunks: tuple[bytes, bytes], data: bytes = b"") -> bytes:
    """A PNG of grey pixels with any size in its header."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    start = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    rest = b"".join(chunk(*each) for each in chunks)
    return b"\x89PNG\r\n\x1a\n" + start + rest + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def observations(*lines: str) -> bytes:
    return ("frame,point,x,y\n" + "\n".join(lines) + "\n").encode()

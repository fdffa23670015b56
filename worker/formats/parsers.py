"""The parsers that run in a child process, by name, and how a file is recognised as theirs."""

from __future__ import annotations

from collections.abc import Callable
from typing import IO

from pliant.solver import InvalidInput
from pliant.worker.formats.arrays import pickle_refusal
from pliant.worker.formats.csv_tracks import looks_like_csv, read_csv
from pliant.worker.formats.errors import refusal, too_large
from pliant.worker.formats.gltf_mesh import read_glb, read_gltf
from pliant.worker.formats.hdf5 import SIGNATURE, read_matlab73
from pliant.worker.formats.mask import read_png
from pliant.worker.formats.matlab import VERSION_5, read_matlab5
from pliant.worker.formats.meshes import read_obj, read_ply
from pliant.worker.formats.records import Arrays, Limits

Parser = Callable[..., Arrays]

PARSERS: dict[str, Parser] = {
    "matlab5": read_matlab5,
    "matlab73": read_matlab73,
    "csv": read_csv,
    "obj": read_obj,
    "ply": read_ply,
    "glb": read_glb,
    "gltf": read_gltf,
    "png": read_png,
}
PICKLE = tuple(bytes([0x80, version]) for version in range(2, 6))


def recognise(head: bytes, field: str) -> str:
    """Name the parser for a file by its first kilobyte.

    Raises
    ------
    InvalidInput
        Codes unknown_format and pickle_refused.
    """
    if head.startswith(PICKLE):
        raise pickle_refusal(field)
    starts = {VERSION_5: "matlab5", b"ply\n": "ply", b"ply\r": "ply", b"glTF": "glb", b"\x89PNG\r\n": "png"}
    for start, name in starts.items():
        if head.startswith(start):
            return name
    if head.startswith(SIGNATURE) or head[512:].startswith(SIGNATURE):
        return "matlab73"
    if _is_text(head):
        if field == "mesh":
            return "gltf" if head.lstrip().startswith(b"{") else "obj"
        if looks_like_csv(head):
            return "csv"
    raise unknown_format(field, head)


def parse(parser: Parser, stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Run a parser; running out of memory is the file's fault, since the limits left enough for honest ones."""
    try:
        return parser(stream, field=field, limits=limits)
    except MemoryError as error:
        raise too_large(field, expected="a file that fits into memory", got="one that does not") from error


def unknown_format(field: str, head: bytes) -> InvalidInput:
    """Say that none of the readers knows the file."""
    mesh = "npz, npy, OBJ, PLY, glTF, GLB or a PNG mask"
    kinds = mesh if field == "mesh" else "npz, npy, MATLAB .mat or CSV with the columns frame, point, x, y"
    return refusal(
        "unknown_format", field, expected=f"{kinds}, recognised by content", got=f"a file that starts with {head[:16]!r}",
        hint="Convert it, e.g. numpy.savez('tracks.npz', tracks=points, visibility=visible).",
    )  # fmt: skip


def _is_text(head: bytes) -> bool:
    return b"\0" not in head and sum(byte < 9 or 13 < byte < 32 for byte in head) == 0

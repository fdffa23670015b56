"""Containers: recognise a file by its first bytes and get the named arrays out of it."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import IO

from pliant.solver import InvalidInput
from pliant.worker.formats.arrays import NPY_MAGIC, pickle_refusal, read_file
from pliant.worker.formats.errors import refusal, too_large
from pliant.worker.formats.matlab import VERSION_5, read_matlab5
from pliant.worker.formats.meshes import read_obj, read_ply
from pliant.worker.formats.records import Arrays, Limits

Parser = Callable[..., Arrays]

ZIP = (b"PK\x03\x04", b"PK\x05\x06")
PICKLE = tuple(bytes([0x80, version]) for version in range(2, 6))


def read_arrays(path: Path, *, field: str, limits: Limits, wanted: Collection[str]) -> Arrays:
    """Get the named arrays out of a file of any known container.

    Raises
    ------
    InvalidInput
        Codes unknown_format, empty_file, too_large, pickle_refused and those of the container's reader.
    """
    size = path.stat().st_size
    if size > limits.max_bytes:
        raise too_large(field, expected=f"a file of at most {limits.max_bytes} bytes", got=f"{size} bytes")
    with path.open("rb") as file:
        head = file.read(1024)
        if not head:
            raise refusal(
                "empty_file", field, expected="a file with content", got="0 bytes", hint="Send the file again."
            )
        if head.startswith((NPY_MAGIC, *ZIP)):
            return read_file(path, field=field, limits=limits, wanted=wanted)
        parser = parser_for(head, field)
        file.seek(0)
        return parse(parser, file, field=field, limits=limits)


def parser_for(head: bytes, field: str) -> Parser:
    """Find the parser for everything but plain NumPy files, from the first kilobyte.

    Raises
    ------
    InvalidInput
        Codes unknown_format and pickle_refused.
    """
    if head.startswith(PICKLE):
        raise pickle_refusal(field)
    if head.startswith(VERSION_5):
        return read_matlab5
    if head.startswith((b"ply\n", b"ply\r")):
        return read_ply
    if field == "mesh" and _is_text(head):
        return read_obj
    raise unknown_format(field, head)


def parse(parser: Parser, stream: IO[bytes], *, field: str, limits: Limits) -> Arrays:
    """Run a parser; running out of memory is the file's fault, since the limits left enough for honest ones."""
    try:
        return parser(stream, field=field, limits=limits)
    except MemoryError as error:
        raise too_large(field, expected="a file that fits into memory", got="one that does not") from error


def unknown_format(field: str, head: bytes) -> InvalidInput:
    """None of the readers knows the file."""
    kinds = "npz, npy, OBJ, PLY" if field == "mesh" else "npz, npy or MATLAB .mat"
    return refusal(
        "unknown_format", field, expected=f"{kinds}, recognised by content", got=f"a file that starts with {head[:16]!r}",
        hint="Convert it, e.g. numpy.savez('tracks.npz', tracks=points, visibility=visible).",
    )  # fmt: skip


def _is_text(head: bytes) -> bool:
    return b"\0" not in head and sum(byte < 9 or 13 < byte < 32 for byte in head) == 0
